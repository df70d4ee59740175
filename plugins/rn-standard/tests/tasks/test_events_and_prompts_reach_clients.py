"""Events as resources, told to those that subscribe; prompts, models, postures and approval, over
MCP.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from mcp import Client, types
from mcp.shared.exceptions import MCPError
from pydantic import BaseModel, Field

from rn_standard.ops.plugin import CLIENTS
from rn_standard.tasks.events import Crossing, check_thresholds
from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.options import EventOptions
from rn_standard.tasks.plugin import FEATURE, MONITORS
from rn_standard.tasks.predicates import parse_predicate
from rn_standard.tasks.prompts import PROMPTS, filled
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import InvalidInputError, RoboNeuronError
from roboneuron.plugins.specs import PLUGIN_KINDS
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application

CONFIG = """
[robot]
name = "gantry"
[models.quick]
backend = "instant"
summary = "for tests"
[models.absent]
backend = "absent"
[postures.rest]
joints = {x = 0.1}
[places.shelf]
position_m = [0.4, 0.0, 0.3]
[tasks]
approval = ["run_task", "move_to"]
approval_roles = ["operator", "admin"]
"""
FIELD = {
    "kind": "field",
    "topic": "weight",
    "type": "std_msgs/msg/Float64",
    "field": "data",
    "at_least": 1.0,
}


class ReaderOptions(BaseModel):
    weights_file: str = Field(default="", description="a file")
    least: float = Field(default=0.1, description="a number")


class Reader:
    """A monitor with a file."""

    def __init__(self, config: ReaderOptions | None) -> None:
        pass


READER = MonitorSpec(
    name="reader",
    summary="For tests.",
    target=f"{__name__}:Reader",
    config=f"{__name__}:ReaderOptions",
)


@pytest.fixture(scope="module")
def application(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Application]:
    """The fakes and this feature; nothing may be spawned."""
    registry = replace(
        fake_registry(SELECTION, FEATURE, CLIENTS, DIRECT_PATH, *MONITORS, READER),
        kinds={**PLUGIN_KINDS, MonitorSpec.kind: MonitorSpec},
    )
    made = Application(
        parse_config(CONFIG, registry=registry),
        plugins=lambda: registry,
        directory=tmp_path_factory.mktemp("state"),
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    made.events.open.tell()
    try:
        yield made
    finally:
        made.close()


def call(application: Application, tool: str, arguments: dict[str, Any]) -> types.CallToolResult:
    async def ask() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(tool, arguments)

    return anyio.run(ask)


def text_of(result: types.CallToolResult) -> str:
    return " ".join(part.text for part in result.content if isinstance(part, types.TextContent))


def test_a_fault_becomes_an_event_that_subscribers_hear_of(application: Application) -> None:
    uri = "roboneuron://events/incidents"

    async def run() -> tuple[list[str], Any]:
        async with Client(application.server) as client:
            await client.list_tools()
            async with client.listen(resource_subscriptions=[uri]) as changes:
                application.events.fault.tell("robot", "memory", {"explanation": "too much"})
                application.events.fault.tell("robot", "memory", {"explanation": "again"})
                with anyio.fail_after(20):
                    async for change in changes:
                        heard = [str(change.uri)]
                        break
            read = (await client.read_resource(uri)).contents[0]
            assert isinstance(read, types.TextResourceContents)
            return heard, json.loads(read.text)

    heard, read = anyio.run(run)
    assert heard == [uri]
    assert [(event["module"], event["what"]) for event in read["events"]] == [("robot", "memory")]


def test_an_agent_cannot_choose_a_monitor_of_the_configuration(application: Application) -> None:
    until = {"kind": "monitor", "name": "http-judge", "options": {"url": "http://example.org/"}}
    result = call(application, "run_task", {"instruction": "go", "until": until})
    assert result.is_error
    assert "http-judge' is not for predicates" in text_of(result)
    assert "[tasks.monitor]" in text_of(result)


def test_an_agent_cannot_point_a_monitor_at_a_file(application: Application) -> None:
    until = {"kind": "monitor", "name": "reader", "options": {"weights_file": "/etc/passwd"}}
    result = call(application, "run_task", {"instruction": "go", "until": until})
    assert result.is_error
    assert "Only the configuration may set weights_file of monitor 'reader'" in text_of(result)
    until["options"] = {"least": 0.5}
    # refused by what comes later: nothing runs
    assert "Only the configuration" not in text_of(
        call(application, "run_task", {"instruction": "go", "until": until})
    )


def test_a_monitor_that_is_not_installed_is_a_mistake_of_the_configuration(
    tmp_path: Path,
) -> None:
    registry = replace(
        fake_registry(SELECTION, FEATURE, CLIENTS, DIRECT_PATH, *MONITORS),
        kinds={**PLUGIN_KINDS, MonitorSpec.kind: MonitorSpec},
    )
    config = parse_config(
        '[robot]\nname = "gantry"\n[tasks.monitor]\nname = "oracle"\n', registry=registry
    )
    with pytest.raises(RoboNeuronError, match="oracle"):
        Application(config, plugins=lambda: registry, directory=tmp_path).close()


def test_all_kinds_of_events_and_the_predicates_are_resources(application: Application) -> None:
    uris = {resource.uri for resource in application.resources.values()}
    assert {
        f"roboneuron://events/{kind}"
        for kind in ("incidents", "tasks", "monitors", "battery", "thresholds")
    } <= uris
    text = application.resources["roboneuron://tasks/predicates"].read()
    assert len(text.encode()) < 2000
    predicates = json.loads(text)
    assert "colour-lifted" in predicates["monitors"]
    assert len(predicates["examples"]) == 3
    for example in predicates["examples"].values():
        parse_predicate(example)


def test_crossings_are_told_once_until_the_value_comes_back() -> None:
    crossing = Crossing(above=10.0, below=None, hysteresis=2.0)
    values = [5, 11, 12, 9, 11, 7.9, math.nan, 11]
    assert [crossing.observe(value) for value in values] == [
        False,
        True,
        False,
        False,
        False,
        True,
        False,
        True,
    ]


def test_a_low_battery_is_an_event(application: Application) -> None:
    feature: Any = application.features.loaded.get("tasks")
    low = Crossing(None, 0.2, 0.05)
    for share in (0.5, 0.19, 0.18, 0.3):
        feature._watching._on_battery(low, SimpleNamespace(percentage=share))
    events = json.loads(application.resources["roboneuron://events/battery"].read())["events"]
    assert [(event["low"], event["charge"]) for event in events] == [(True, 0.19), (False, 0.3)]


def test_prompts_are_listed_and_filled(application: Application) -> None:
    async def ask() -> tuple[set[str], str]:
        async with Client(application.server) as client:
            listed = {prompt.name for prompt in (await client.list_prompts()).prompts}
            got = await client.get_prompt("pick_up", {"colour": "blue"})
            content = got.messages[0].content
            assert isinstance(content, types.TextContent)
            return listed, content.text

    listed, text = anyio.run(ask)
    assert listed == set(PROMPTS)
    assert '"pick up the blue cube"' in text


@pytest.mark.parametrize(
    ("name", "arguments"), [("absent", {}), ("pick_up", {}), ("bring_up", {"x": "1"})]
)
def test_a_prompt_that_cannot_be_filled_is_an_error(name: str, arguments: dict[str, str]) -> None:
    with pytest.raises(MCPError):
        filled(name, arguments)


def test_models_are_listed_with_why_one_cannot_be_used(application: Application) -> None:
    models = (call(application, "list_models", {}).structured_content or {})["models"]
    assert (models[0]["name"], models[0]["installed"], models[0]["summary"]) == (
        "quick",
        True,
        "for tests",
    )
    assert not models[1]["installed"]
    assert "absent" in models[1]["problem"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"model": "nope"}, "There is no model 'nope'"),
        ({"model": "quick", "backend": "instant"}, "names its backend itself"),
        ({"model": "absent"}, "absent"),
    ],
)
def test_a_model_that_cannot_be_started_is_refused(
    application: Application, arguments: dict[str, Any], text: str
):
    result = call(application, "start_inference", arguments)
    assert result.is_error
    assert text in text_of(result)


def test_a_client_that_cannot_ask_a_person_is_refused_where_approval_is_wanted(
    application: Application,
) -> None:
    result = call(application, "move_to", {"name": "rest"})
    assert result.is_error
    assert "A person must approve move_to" in text_of(result)


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("run_task", {"instruction": "go", "on_end": "nowhere"}),
        ("run_task", {"instruction": "go"}),  # the robot is not running
        ("move_to", {"name": "nowhere"}),
    ],
)
def test_no_person_is_asked_about_a_call_that_is_refused(
    application: Application, tool: str, arguments: dict[str, Any]
) -> None:
    async def answer(context: Any, params: Any) -> types.ElicitResult:
        pytest.fail(params.message)

    async def ask() -> types.CallToolResult:
        async with Client(application.server, elicitation_callback=answer) as client:
            return await client.call_tool(tool, arguments)

    result = anyio.run(ask)
    assert result.is_error
    assert "approve" not in text_of(result)


@pytest.mark.parametrize("agrees", [True, False])
def test_a_person_is_asked_before_the_arm_moves(application: Application, agrees: bool) -> None:
    asked: list[str] = []

    async def answer(context: Any, params: Any) -> types.ElicitResult:
        asked.append(params.message)
        return types.ElicitResult(
            action="accept" if agrees else "decline", content={"confirmed": agrees}
        )

    async def ask() -> types.CallToolResult:
        async with Client(application.server, elicitation_callback=answer) as client:
            return await client.call_tool("move_to", {"name": "rest"})

    result = anyio.run(ask)
    assert asked == ['Let the robot move to "rest"?']
    assert result.is_error
    expected = "There is no tool move_joints now" if agrees else "A person did not approve move_to"
    assert expected in text_of(result)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"instruction": "x", "until": {"kind": "maybe"}}, "until"),
        ({"instruction": "x", "on_end": "nowhere"}, "Choose one of: hold, stop"),
        ({"instruction": "x", "until": {"kind": "monitor", "name": "absent"}}, "absent"),
        ({"instruction": "x"}, "robot is not running"),
        ({"instruction": " "}, "empty"),
        ({"instruction": "pick\0up"}, "control character U+0000 at position 4"),
        (
            {"instruction": "x", "until": {**FIELD, "topic": "/x y"}},
            "'/x y' is not a topic name. A name is words",
        ),
        ({"instruction": "x", "until": {**FIELD, "topic": "/x\0"}}, "is not a topic name"),
        (
            {"instruction": "x", "until": {**FIELD, "topic": "sim/state"}},
            "what only the simulator knows",
        ),
        (
            {"instruction": "x", "until": {**FIELD, "type": "nope_msgs/msg/Nope"}},
            "No installed interface",
        ),
        (
            {"instruction": "x", "until": {**FIELD, "field": "__class__.__init__.__globals__"}},
            "std_msgs/msg/Float64 has no field '__class__.__init__.__globals__'. "
            "std_msgs/msg/Float64 has: data.",
        ),
        (
            {"instruction": "x", "until": {"kind": "not", "of": {**FIELD, "field": "data.real"}}},
            "it has no fields",
        ),
    ],
)
def test_a_task_that_cannot_be_carried_out_is_refused(
    application: Application, arguments: Any, text: str
) -> None:
    result = call(application, "run_task", arguments)
    assert result.is_error
    assert text in text_of(result)


@pytest.mark.parametrize(
    ("threshold", "text"),
    [
        ({"topic": "/x y", "field": "data"}, "is not a topic name"),
        ({"topic": "weight", "field": "data.__class__"}, "it has no fields"),
        ({"topic": "weight", "field": "load"}, "has no field 'load'"),
    ],
)
def test_a_threshold_on_what_cannot_be_is_refused_with_the_configuration(
    threshold: Any, text: str
) -> None:
    options = EventOptions.model_validate(
        {"thresholds": {"heavy": {"type": "std_msgs/msg/Float64", **threshold}}}
    )
    with pytest.raises(InvalidInputError, match=r"\[events.thresholds.heavy\]: .*" + text):
        check_thresholds(options)
