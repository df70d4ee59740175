"""Tools that few requests need are found by search; what the called robot checks, and who may call
it, stays.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from mcp import types

from rn_standard.fleet.fleet import Fleet
from rn_standard.fleet.schemas import without_summaries
from roboneuron.config import parse_config
from roboneuron.plugins.discovery import discover

Call = Callable[..., types.CallToolResult]
MOST_BYTES = 34_000
"""Of four robots of two kinds with the packages that are usually installed; it was 53 kB, about
14,400 tokens.
"""
FOUR = """
disabled_plugins = ["rn-recorder", "rn-eval-libero", "rn-backend-openpi"]
[robots.left]
robot = "fr3"
[robots.left.inference]
backend = "servo"
[robots.right]
robot = "fr3"
[robots.base]
robot = "husky"
[robots.rover]
robot = "husky"
"""


def text_of(answer: types.CallToolResult) -> str:
    return str(answer.content[0].text)  # type: ignore[union-attr]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A fleet of two arms and two bases with the installed packages; nothing is started."""
    fleet = Fleet(parse_config(FOUR, registry=discover()), tmp_path_factory.mktemp("fleet"))
    yield fleet
    fleet.close()


def test_the_list_of_four_robots_fits_a_bound(installed: Fleet) -> None:
    listing = types.ListToolsResult(tools=installed.tools.listing())
    size = len(listing.model_dump_json(by_alias=True, exclude_none=True).encode())
    assert size <= MOST_BYTES, f"tools/list is {size} bytes"


def test_what_moves_stops_or_shows_a_robot_is_listed(installed: Fleet) -> None:
    names = {tool.name for tool in installed.tools.listing()}
    assert {"start_all", "run_task", "stop_inference", "stop_all", "get_status", "move_ee"} <= names
    assert not {name for name in names if name.startswith(("list_", "switch_"))} - {
        "list_fleet",
        "list_incidents",
        "list_tasks",
    }


def test_policies_are_offered_for_robots_that_take_them(installed: Fleet) -> None:
    tools = {tool.name: tool for tool in installed.tools.listing()}
    for name in ("set_instruction", "start_inference", "stop_inference", "run_task"):
        assert tools[name].input_schema["properties"]["robot"]["enum"] == ["left", "right"], name
    assert tools["stop_robot"].input_schema["properties"]["robot"]["enum"] == [
        "left",
        "right",
        "base",
        "rover",
    ]
    offered = {tool.name for tool in installed.robots["base"].tools.listing()}
    assert not offered & {"set_instruction", "start_inference", "run_task", "switch_inference"}


@pytest.mark.parametrize(
    ("query", "first"), [("describe interface", "describe_interface"), ("nodes", "list_nodes")]
)
def test_other_tools_are_found_by_words(call: Call, fleet: Fleet, query: str, first: str) -> None:
    found = (call(fleet, "find_robot_tools", {"query": query}).structured_content or {})["tools"]
    assert found[0]["name"] == first
    assert found[0]["robots"] == ["left", "right-arm"]
    assert "robot" not in found[0]["input_schema"]["properties"]


def test_all_of_them_are_named_without_words(call: Call, fleet: Fleet) -> None:
    found = (call(fleet, "find_robot_tools", {}).structured_content or {})["tools"]
    assert {"describe_interface", "list_topics", "list_nodes"} <= {tool["name"] for tool in found}
    assert len(json.dumps(found)) < 6000
    assert not {tool["name"] for tool in found} & {tool.name for tool in fleet.tools.listing()}


def test_a_found_tool_is_called_for_one_robot_and_checked_there(call: Call, fleet: Fleet) -> None:
    named = {"robot": "left", "tool": "describe_interface"}
    answer = call(fleet, "call_robot_tool", {**named, "arguments": {"type": "std_msgs/msg/Bool"}})
    assert (answer.structured_content or {})["name"] == "std_msgs/msg/Bool"
    for arguments, text in (
        ({**named, "arguments": {"type": 3}}, "Argument 'type' is 3"),
        ({**named, "arguments": {"typ": "x"}}, "Did you mean 'type'?"),
        ({**named, "robot": "middle"}, "There is no robot 'middle'"),
        ({**named, "tool": "fly"}, "There is no tool 'fly'"),
        ({"robot": "left"}, "Argument 'tool' is missing"),
        ({**named, "tool": "call_robot_tool"}, "There is no tool 'call_robot_tool'"),
    ):
        refused = call(fleet, "call_robot_tool", arguments)
        assert refused.is_error
        assert text in text_of(refused)


def test_a_listed_tool_is_called_by_its_own_name_too(call: Call, fleet: Fleet) -> None:
    answer = call(fleet, "call_robot_tool", {"robot": "right-arm", "tool": "get_status"})
    assert (answer.structured_content or {})["namespace"] == "right_arm"


def test_the_robot_sees_the_call_that_is_meant(call: Call, fleet: Fleet) -> None:
    seen: list[Any] = []

    fleet.robots["left"].events.call_ended.listen(
        lambda ended: seen.append((ended.call.name, dict(ended.call.arguments)))
    )
    call(
        fleet,
        "call_robot_tool",
        {"robot": "left", "tool": "list_nodes", "arguments": {"entries": 3}},
    )
    assert seen == [("list_nodes", {"entries": 3})]


def test_one_robot_has_the_whole_list(make_fleet: Callable[[str], Fleet]) -> None:
    names = {tool.name for tool in make_fleet('[robots.only]\nrobot = "gantry"\n').tools.listing()}
    assert {"list_topics", "describe_interface"} <= names
    assert not names & {"find_robot_tools", "call_robot_tool"}


def test_summaries_of_choices_are_left_to_the_lists() -> None:
    entry = {"type": "string", "enum": ["a"], "description": "Which one. Choices: a: the first."}
    assert without_summaries(entry) == {
        "type": "string",
        "enum": ["a"],
        "description": "Which one.",
    }
    assert without_summaries({"type": "string", "description": "Choices: none."}) == {
        "type": "string",
        "description": "Choices: none.",
    }
