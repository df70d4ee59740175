"""The chain and the events of a robot see the calls of that robot, as in a server of one robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcp import types

from rn_standard.fleet.fleet import Fleet
from roboneuron.feature import (
    Answer,
    CallPhase,
    EndedCall,
    IncomingCall,
    Interceptor,
    Proceed,
    Simulator,
)

Call = Callable[..., types.CallToolResult]


@pytest.fixture
def seen(fleet: Fleet) -> list[tuple[str, str, dict[str, Any], bool]]:
    """Robot, tool, arguments and failure of each call that a robot has seen."""
    calls: list[tuple[str, str, dict[str, Any], bool]] = []

    def watching(robot: str) -> Callable[[EndedCall], None]:
        return lambda ended: calls.append(
            (robot, ended.call.name, dict(ended.call.arguments), bool(ended.code))
        )

    for name, robot in fleet.robots.items():
        robot.events.call_ended.listen(watching(name))
    return calls


def test_a_call_is_seen_by_the_robot_it_names_alone(
    fleet: Fleet, call: Call, seen: list[Any]
) -> None:
    answer = call(fleet, "get_status", {"robot": "right-arm"})
    assert not answer.is_error
    assert seen == [("right-arm", "get_status", {}, False)]


def test_a_call_that_a_robot_refuses_is_seen(fleet: Fleet, call: Call, seen: list[Any]) -> None:
    assert call(fleet, "stop_robot", {"robot": "left", "nonsense": 1}).is_error
    assert seen == [("left", "stop_robot", {"nonsense": 1}, True)]


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("get_status", {}),
        ("get_status", {"robot": {"a": 1}}),
        ("list_fleet", {}),
        ("fly", {"robot": "left"}),
    ],
)
def test_a_call_of_no_robot_is_seen_by_none(
    fleet: Fleet, call: Call, seen: list[Any], tool: str, arguments: dict[str, Any]
) -> None:
    call(fleet, tool, arguments)
    assert seen == []


def test_a_simulated_call_is_handed_to_the_twin_of_the_robot_it_names(
    fleet: Fleet, call: Call, seen: list[Any]
) -> None:
    simulator = Simulator(tool="get_status", is_there=lambda: True)
    fleet.robots["left"].tools.chain.simulate_with(simulator)
    for robot in fleet.robots.values():
        stop = robot.tools.get("stop_robot")
        assert stop is not None
        simulated = replace(stop, name="rehearse_stop", simulated_by=frozenset({"twin"}))
        robot.tools.add_all([simulated])
    for name in ("left", "right-arm"):
        call(fleet, "rehearse_stop", {"robot": name, "simulate": True})
    assert seen == [
        ("left", "get_status", {"tool": "rehearse_stop", "arguments": {}}, True),
        ("right-arm", "rehearse_stop", {}, True),
    ]


def test_the_only_robot_of_a_table_need_not_be_named(
    call: Call, make_fleet: Callable[..., Fleet]
) -> None:
    fleet = make_fleet('[robots.only]\nrobot = "gantry"\n')
    seen: list[str] = []

    fleet.robots["only"].events.call_ended.listen(lambda ended: seen.append(ended.call.name))
    call(fleet, "get_status")
    assert seen == ["get_status"]


def test_each_folder_says_which_namespace_it_is_of(
    tmp_path: Path, make_fleet: Callable[..., Fleet]
) -> None:
    text = (
        '[robots.left]\nrobot = {name = "gantry", namespace = "hall_2/a"}\n[robots.b-1]\nrobot '
        '= "gantry"\n'
    )
    make_fleet(text)._note_namespaces()  # as `open` does
    noted = {path.parent.name: path.read_text() for path in tmp_path.glob("robots/*/namespace")}
    assert noted == {"left": "hall_2/a", "b-1": "b_1"}


def test_a_feature_of_a_robot_hands_on_another_call_of_that_robot(
    fleet: Fleet, call: Call, seen: list[Any]
) -> None:
    robot = fleet.robots["right-arm"]

    async def other(call: IncomingCall, proceed: Proceed) -> Answer:
        found = robot.tools.get("get_status")
        return await proceed(replace(call, name="get_status", arguments={}, found=found))

    step = Interceptor(name="other", phase=CallPhase.PERMISSION, around=other)
    robot.tools.chain.intercept([step])
    answer = call(fleet, "stop_robot", {"robot": "right-arm"})
    assert not answer.is_error
    assert "modules" in (answer.structured_content or {})
    assert "modules" not in (call(fleet, "stop_robot", {"robot": "left"}).structured_content or {})
