"""Every tool takes `robot`, and a call reaches that robot alone; without one the choices are
listed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import anyio
import pytest
from mcp import Client, types
from mcp.shared.exceptions import MCPError

from rn_standard.fleet.fleet import Fleet

Call = Callable[..., types.CallToolResult]


def test_every_tool_of_a_robot_requires_the_robot(fleet: Fleet) -> None:
    tools = {tool.name: tool for tool in fleet.tools.listing()}
    assert {"list_fleet", "emergency_stop", "start_robot", "get_status"} <= tools.keys()
    for name in tools.keys() - {
        "list_fleet",
        "emergency_stop",
        "stop_motion",
        "find_robot_tools",
        "call_robot_tool",
    }:
        schema = tools[name].input_schema
        assert schema["properties"]["robot"]["enum"] == ["left", "right-arm"], name
        assert schema["required"][0] == "robot", name
    assert "robot" not in tools["emergency_stop"].input_schema.get("required", ())


def test_one_robot_in_the_table_need_not_be_named(
    call: Call, make_fleet: Callable[..., Fleet]
) -> None:
    fleet = make_fleet('[robots.only]\nrobot = "gantry"\n')
    for tool in fleet.tools.listing():
        assert "robot" not in tool.input_schema.get("required", ()), tool.name
    answer = call(fleet, "get_status").structured_content
    assert answer is not None
    assert answer["namespace"] == "only"


def test_each_robot_answers_for_itself(call: Call, fleet: Fleet) -> None:
    for name, namespace in (("left", "left"), ("right-arm", "right_arm")):
        answer = call(fleet, "get_status", {"robot": name}).structured_content
        assert answer is not None
        assert answer["namespace"] == namespace


@pytest.mark.parametrize(
    ("tool", "arguments", "expected"),
    [
        (
            "get_status",
            {},
            "get_status needs `robot`, which robot is meant. Choose one of: left, right-arm.",
        ),
        ("get_status", {"robot": "lefft"}, "There is no robot 'lefft'. Did you mean 'left'?"),
        ("get_status", {"robot": 7}, "There is no robot '7'."),
        ("fly", {"robot": "left"}, "There is no tool 'fly'."),
    ],
)
def test_a_call_that_names_no_robot_is_refused_with_the_choices(
    call: Call, fleet: Fleet, tool: str, arguments: dict[str, object], expected: str
) -> None:
    answer = call(fleet, tool, arguments)
    assert answer.is_error
    assert answer.content[0].text.startswith(expected)


def test_a_tool_of_another_robot_is_refused_with_those_that_have_it(
    call: Call, fleet: Fleet
) -> None:
    tools = fleet.robots["left"].tools
    known = tools.get("get_status")
    assert known is not None
    tools.add_all([replace(known, name="get_more")])
    answer = call(fleet, "get_more", {"robot": "right-arm"})
    assert answer.is_error
    assert (
        answer.content[0].text == "The robot 'right-arm' has no tool get_more. Choose one of: left."
    )


def test_the_fleet_is_listed(call: Call, fleet: Fleet) -> None:
    answer = call(fleet, "list_fleet").structured_content
    assert answer is not None
    assert [(one["name"], one["robot"], one["namespace"]) for one in answer["robots"]] == [
        ("left", "gantry", "left"),
        ("right-arm", "gantry", "right_arm"),
    ]


def test_resources_carry_the_name_of_their_robot(fleet: Fleet) -> None:
    async def ask() -> tuple[list[str], str]:
        async with Client(fleet.server) as client:
            uris = [str(resource.uri) for resource in (await client.list_resources()).resources]
            content = (await client.read_resource("roboneuron://right-arm/status")).contents[0]
            with pytest.raises(MCPError, match="roboneuron://left/"):
                await client.read_resource("roboneuron://status")
            return uris, str(content.uri) + content.model_dump()["text"]

    uris, read = anyio.run(ask)
    assert {"roboneuron://left/status", "roboneuron://right-arm/status"} <= set(uris)
    assert read.startswith("roboneuron://right-arm/status{")
    assert '"namespace": "right_arm"' in read


def test_a_client_hears_of_the_robot_whose_status_changed(fleet: Fleet) -> None:
    uri = "roboneuron://right-arm/status"

    async def ask() -> str:
        async with Client(fleet.server) as client:
            await client.list_tools()
            async with client.listen(resource_subscriptions=[uri]) as changes:
                fleet.robots["left"].events.resource.tell("roboneuron://status")
                fleet.robots["right-arm"].events.resource.tell("roboneuron://status")
                with anyio.fail_after(60):
                    async for change in changes:
                        return str(change.uri)
        return ""

    assert anyio.run(ask) == uri


def test_the_instructions_name_the_robots(fleet: Fleet) -> None:
    told = str(fleet.server.instructions)
    assert (
        "2 robots: left (simulated robot gantry (driver simulated)), right-arm (simulated robot "
        "gantry" in told
    )
