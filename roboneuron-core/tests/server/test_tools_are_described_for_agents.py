"""Tool descriptions for agents: names, schemas, choices, annotations, results."""

from __future__ import annotations

import json
import re
import time
from typing import Any

import anyio
import jsonschema
import pytest
from mcp import Client, types
from mcp.shared.exceptions import MCPError

from rn_testing.fakes import fake_registry
from roboneuron.config import Config
from roboneuron.modules.report import Report
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, RobotSpec
from roboneuron.server.app import Application
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool
from roboneuron.supervisor.health import ModuleView
from roboneuron.tools.loop.results import ModuleStatus

TOOLS = {
    *("start_robot", "start_perception", "start_control", "start_inference", "set_instruction"),
    *("stop_robot", "stop_perception", "stop_control", "stop_inference", "stop_all"),
    *("get_status", "emergency_stop", "reset_emergency_stop"),
}


def listing(application: Application, mode: str = "auto") -> dict[str, types.Tool]:
    async def ask() -> dict[str, types.Tool]:
        async with Client(application.server, mode=mode) as client:  # type: ignore[arg-type]
            return {tool.name: tool for tool in (await client.list_tools()).tools}

    return anyio.run(ask)


def call(
    application: Application, name: str, arguments: dict[str, Any] | None = None
) -> types.CallToolResult:
    async def ask() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(name, arguments or {})

    return anyio.run(ask)


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_all_tools_are_listed_to_clients_of_both_eras(application: Application, mode: str) -> None:
    assert set(listing(application, mode)) == TOOLS


def test_every_tool_has_strict_schemas_and_descriptions(application: Application) -> None:
    for tool in listing(application).values():
        assert tool.description
        assert len(tool.description) > 20
        for schema in (tool.input_schema, tool.output_schema):
            assert schema is not None
            jsonschema.Draft202012Validator.check_schema(schema)
            assert schema["type"] == "object"
        assert tool.input_schema["additionalProperties"] is False
        for name, entry in tool.input_schema["properties"].items():
            assert entry.get("description"), f"{tool.name}.{name}"
            assert "anyOf" not in entry, f"{tool.name}.{name}"


def test_annotations_tell_what_a_tool_may_do(application: Application) -> None:
    for tool in listing(application).values():
        hints = tool.annotations
        assert hints is not None
        reads = tool.name.startswith(("list_", "get_", "read_", "describe_"))
        assert hints.read_only_hint == reads
        assert bool(hints.destructive_hint) == (
            tool.name.startswith(("stop_", "emergency", "reset"))
        )
        assert not (hints.read_only_hint and hints.destructive_hint)


def test_without_plugins_there_are_no_empty_enums() -> None:
    empty = Registry(plugins=(), all_offers=())
    config = Config.model_validate({"robot": {"name": "gantry"}})
    application = Application(config, plugins=lambda: empty)
    for tool in application.tools.listing():
        assert all(
            "enum" not in entry or entry["enum"]
            for entry in tool.input_schema["properties"].values()
        )
    application.close()


def test_status_is_typed(application: Application) -> None:
    status = call(application, "get_status")
    assert json.loads(status.content[0].text) == status.structured_content  # type: ignore[union-attr]
    assert [m["module"] for m in status.structured_content["modules"]] == [
        "robot",
        "perception",
        "inference",
        "control",
    ]
    assert {m["phase"] for m in status.structured_content["modules"]} == {"stopped"}
    assert status.structured_content["namespace"] == "gantry"


def test_the_status_is_a_resource(application: Application) -> None:
    async def ask() -> None:
        async with Client(application.server) as client:
            uris = {str(resource.uri) for resource in (await client.list_resources()).resources}
            assert uris == {"roboneuron://status"}
            status = (await client.read_resource("roboneuron://status")).contents[0]
            assert json.loads(status.text)["namespace"] == "gantry"  # type: ignore[union-attr]
            with pytest.raises(MCPError, match=r"no resource 'roboneuron://secret'") as caught:
                await client.read_resource("roboneuron://secret")
            assert caught.value.error.data == {"uri": "roboneuron://secret"}

    anyio.run(ask)


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_lists_are_answered_with_the_same_hints_also_when_empty(
    application: Application, mode: Any
) -> None:
    """Clients ask for templates wherever there are resources."""

    async def ask() -> None:
        async with Client(application.server, mode=mode) as client:
            listed = await client.list_resources()
            templates = await client.list_resource_templates()
            assert templates.resource_templates == []
            assert templates.ttl_ms == listed.ttl_ms
            assert templates.cache_scope == listed.cache_scope

    anyio.run(ask)


def test_the_status_of_nothing_is_short_and_fits_its_whole_schema(application: Application) -> None:
    status = call(application, "get_status").structured_content
    assert status is not None
    assert len(json.dumps(status)) < 1400, "it was 2.7 kB, mostly null"
    assert all(
        value not in (None, "", {}, []) for module in status["modules"] for value in module.values()
    )
    tool = application.tools.get("get_status")
    assert tool is not None
    jsonschema.validate(status, tool.output_schema())


def test_which_robot_it_is_and_whether_a_real_one_is_told_before_anything_runs(
    application: Application,
) -> None:
    facts = {"name": "gantry", "driver": "simulated", "kind": "simulated"}
    status = call(application, "get_status").structured_content
    assert status is not None
    unchecked = status["robot"].pop("unchecked")
    assert "'gantry'" in unchecked, "its description has no shapes"
    assert status["robot"] == facts
    assert str(application.server.instructions).startswith(
        "RoboNeuron operates one simulated robot gantry (driver simulated). "
    )
    assert "simulated robot gantry (driver simulated)" in str(
        listing(application)["start_robot"].description
    )


def test_a_driver_that_does_not_say_that_it_is_simulated_counts_as_real() -> None:
    driver = DriverSpec(name="network", summary="By network.", target="nowhere:X")
    robot = RobotSpec(name="arm", summary="An arm.", target="nowhere:profile", drivers=(driver,))
    registry = fake_registry(robot)
    for name, named in (("arm", "arm"), ("unknown", "unknown")):
        config = Config.model_validate({"robot": {"name": name, "driver": "network"}})
        application = Application(config, plugins=lambda: registry)
        try:
            assert str(application.loop.robot_facts) == f"real robot {named} (driver network)"
        finally:
            application.close()


def test_answers_of_what_acts_name_the_robot_and_those_of_what_reads_do_not(
    application: Application,
) -> None:
    stopped = call(application, "stop_all").structured_content
    assert stopped is not None
    assert stopped["acts_on"] == "simulated robot gantry (driver simulated)"
    assert "acts_on" not in (call(application, "get_status").structured_content or {})


def test_instructions_name_only_tools_that_there_are(application: Application) -> None:
    told = set(re.findall(r"\b[a-z]+(?:_[a-z]+)+\b", str(application.server.instructions)))
    assert told <= TOOLS | {"get_camera_image"}
    assert {"start_robot", "get_status", "stop_inference", "emergency_stop"} <= told
    assert "start_all" not in told


class Long(Result):
    """A long text."""

    text: str


@pytest.mark.parametrize(("read_only", "refused"), [(True, True), (False, False)])
def test_an_answer_too_long_to_read_is_refused_unless_something_was_done(
    application: Application, read_only: bool, refused: bool
) -> None:
    async def handler(_: NoArguments, context: CallContext) -> Long:
        return Long(text="x" * 200_000)

    tool = Tool(
        name="get_much",
        title="Much",
        description="Too much text for an agent.",
        arguments=NoArguments,
        result=Long,
        handler=handler,
        read_only=read_only,
    )
    application.tools.add_all([tool])
    answer = call(application, "get_much")
    assert bool(answer.is_error) is refused
    assert not refused or "Ask for less" in answer.content[0].text  # type: ignore[union-attr]


def test_what_a_plugin_reports_is_cut_in_the_status() -> None:
    long = {f"m{number:03}": "x" * 90 for number in range(500)}
    report = Report(metrics=long, detail=long, note="y" * 90_000, received_s=time.monotonic())
    view = ModuleView(kind="robot", phase="running", report=report)
    told = ModuleStatus.of(view).model_dump(mode="json", exclude_unset=True)
    assert told["metrics"] == told["detail"] == dict(list(long.items())[: len(told["metrics"])])
    assert len(json.dumps(told)) < 20_000, "four of them stay below what an answer may hold"
    assert told["note"].endswith("(90000 characters)")


def test_metrics_and_times_are_told_on_request_only() -> None:
    report = Report(
        rate_hz=5.0,
        latency_ms=1.0,
        age_ms=2.0,
        loop_age_s=0.1,
        metrics={"x": "1"},
        dropped_by={"late": 1},
        received_s=time.monotonic(),
    )
    view = ModuleView(kind="control", phase="running", report=report)
    short = ModuleStatus.of(view, details=False).model_dump(exclude_unset=True)
    whole = ModuleStatus.of(view).model_dump(exclude_unset=True)
    assert whole.keys() - short.keys() == {
        *("metrics", "dropped_by", "latency_ms", "age_ms", "loop_age_s", "report_age_s"),
    }
    assert short["rate_hz"] == 5.0


def test_versions_come_with_the_details(application: Application) -> None:
    told = call(application, "get_status", {"details": True}).structured_content
    assert told is not None
    assert told["versions"]["roboneuron"]
    assert "versions" not in (call(application, "get_status").structured_content or {})
