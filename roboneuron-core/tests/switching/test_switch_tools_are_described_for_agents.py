"""What an agent reads of the switch tools, and how calls are refused that cannot succeed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client, types

from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.switching.plugin import FEATURE


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    """The fakes and this feature."""
    return application_of(SELECTION, FEATURE)


def tools(application: Application) -> dict[str, types.Tool]:
    return {tool.name: tool for tool in application.tools.listing()}


@pytest.mark.parametrize(
    ("kind", "also"),
    [("inference", {"instruction"}), ("perception", {"cameras"}), ("control", set())],
)
def test_a_switch_takes_what_a_start_takes(
    application: Application, kind: str, also: set[str]
) -> None:
    listed = tools(application)
    switch = listed[f"switch_{kind}"].input_schema["properties"]
    start = listed[f"start_{kind}"].input_schema["properties"]
    assert set(switch) == {*start, "mode", "rollback"}
    for name in start:
        assert switch[name].get("type") == start[name].get("type")
        description = switch[name]["description"]
        assert "As in" not in description, "agents read each tool by itself"
        if name not in also and "enum" not in start[name]:
            assert description == start[name]["description"], name
    hints = listed[f"switch_{kind}"].annotations
    assert hints is not None
    assert hints.destructive_hint
    assert not hints.read_only_hint


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({}, "inference is not running"),
        ({"rollback": True}, "inference is not running"),
        (
            {"rollback": True, "backend": "instant"},
            "rollback allows no other argument, got backend",
        ),
        ({"mode": "hot"}, "Choose one of: warm, cold."),
    ],
)
def test_what_cannot_be_switched_is_refused(
    application: Application, arguments: dict[str, Any], text: str
) -> None:
    async def call() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool("switch_inference", arguments)

    result = anyio.run(call)
    assert result.is_error
    block = result.content[0]
    assert isinstance(block, types.TextContent)
    assert text in block.text
