"""What an agent reads of the tools: names, schemas, choices, annotations, results."""

from __future__ import annotations

import json
from typing import Any

import anyio
import jsonschema
import pytest
from mcp import Client, types

from roboneuron.config import Config
from roboneuron.plugins.registry import Registry
from roboneuron.server.app import Application
from roboneuron.server.plugins import PluginCatalogue

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


def call(application: Application, name: str, arguments: dict[str, Any] | None = None) -> types.CallToolResult:
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
        assert bool(hints.destructive_hint) == (tool.name.startswith(("stop_", "emergency", "reset")))
        assert not (hints.read_only_hint and hints.destructive_hint)


def test_without_plugins_there_are_no_empty_enums() -> None:
    empty = Registry(plugins=(), all_offers=())
    config = Config.model_validate({"robot": {"name": "gantry"}})
    application = Application(config, plugins=PluginCatalogue(discover=lambda disabled: empty))
    for tool in application.tools.listing():
        assert all("enum" not in entry or entry["enum"] for entry in tool.input_schema["properties"].values())
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
            with pytest.raises(Exception, match=r"no resource 'roboneuron://secret'"):
                await client.read_resource("roboneuron://secret")

    anyio.run(ask)
