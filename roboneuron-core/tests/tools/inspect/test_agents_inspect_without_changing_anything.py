"""What the tools are listed as, what they answer, and which calls they refuse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client, types

from roboneuron.plugins.specs import BackendSpec
from roboneuron.server.app import Application
from roboneuron.tools.inspect.plugin import FEATURE

TOOLS = {
    *(
        "list_robots",
        "list_perception_sources",
        "list_controllers",
        "list_backends",
        "list_runtimes",
    ),
    *("list_accelerations", "get_camera_image"),
}


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    heavy = BackendSpec(
        name="heavy", summary="Needs weights.", target="nowhere:Heavy", needs_checkpoint=True
    )
    return application_of(heavy, FEATURE)


def call(
    application: Application, name: str, arguments: dict[str, Any] | None = None
) -> types.CallToolResult:
    async def ask() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(name, arguments or {})

    return anyio.run(ask)


def test_the_tools_are_listed_as_reading(application: Application) -> None:
    listing = {tool.name: tool for tool in application.tools.listing()}
    assert listing.keys() >= TOOLS
    for name in TOOLS:
        assert listing[name].annotations.read_only_hint  # type: ignore[union-attr]
    assert listing["get_camera_image"].input_schema["properties"]["camera"]["enum"] == [
        "front",
        "hand",
    ]


def test_lists_say_what_fits(application: Application) -> None:
    answer = call(application, "list_backends")
    assert not answer.is_error
    by_name = {entry["name"]: entry for entry in answer.structured_content["backends"]}
    assert by_name["heavy"]["needs_checkpoint"] is True
    assert by_name["instant"]["needs_state"] is True
    assert by_name["instant"]["status"] == "ready"
    assert by_name["heavy"]["status"] == "not ready"
    assert "checkpoint" in by_name["heavy"]["reason"]
    robots = call(application, "list_robots").structured_content["robots"]
    assert robots[0]["cameras"] == [
        {"name": "front", "role": "primary"},
        {"name": "hand", "role": "wrist"},
    ]
    for name in TOOLS - {"get_camera_image"}:
        assert not call(application, name).is_error


def test_the_first_camera_is_looked_through_when_none_is_named(application: Application) -> None:
    answer = call(application, "get_camera_image", {"timeout_s": 0.01})
    assert "'front'" in answer.content[0].text  # type: ignore[union-attr]
    assert "start_perception" in answer.content[0].text  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"camera": "fornt"}, "Did you mean 'front'? Choose one of: front, hand."),
        ({"camera": "front", "format": "gif"}, "Choose one of: jpeg, png."),
        ({"camera": "front", "timeout_s": 0}, "Argument 'timeout_s' is 0"),
        ({"camera": "front", "timeout_s": True}, "Argument 'timeout_s' is True"),
        ({"camera": "front", "timeout_s": "5"}, "Argument 'timeout_s' is '5'"),
    ],
)
def test_a_bad_call_is_refused_with_a_reason(
    application: Application, arguments: dict[str, Any], words: str
) -> None:
    answer = call(application, "get_camera_image", arguments)
    assert answer.is_error
    assert words in answer.content[0].text  # type: ignore[union-attr]
    assert answer.meta["roboneuron/error"]["code"] == "invalid_input"
