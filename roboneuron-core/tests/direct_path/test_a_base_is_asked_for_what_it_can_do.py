"""A velocity at the very limit of a base passes, and one beside it does not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.twists import check_twist
from roboneuron.errors import RefusedError
from roboneuron.feature import GateRequest

BASE = Endpoint(
    name="velocity",
    kind="publish",
    topic="cmd_vel",
    type="geometry_msgs/msg/Twist",
    summary="Drive.",
    bounds={"linear.x": (-1.0, 2.0), "linear.y": (0.0, 0.0), "linear.z": (0.25, 0.25)},
)
CAR = replace(BASE, bounds={}, min_turning_radius_m=0.5)


@pytest.mark.parametrize(
    "twist",
    [
        *({}, {"linear.x": 2.0}, {"linear.x": -1.0}, {"linear.y": 0.0}, {"linear.z": 0.25}),
        *({"angular.z": 99.0}, {"angular.x": -99.0}),
    ],
)
def test_a_velocity_within_the_bounds_passes(twist: dict[str, float]) -> None:
    check_twist(BASE, twist)


@pytest.mark.parametrize(
    ("twist", "text"),
    [
        ({"linear.x": 2.01}, r"linear\.x is 2\.01, expected -1 \.\. 2: beyond"),
        ({"linear.x": -1.01}, r"linear\.x is -1\.01, expected -1 \.\. 2: beyond"),
        ({"linear.y": -0.01}, r"linear\.y is -0\.01, expected 0: the base cannot"),
        ({"linear.z": 0.3}, r"linear\.z is 0\.3, expected 0\.25 \.\. 0\.25: beyond"),
        ({"linear.z": 0.0}, r"linear\.z is 0, expected 0\.25 \.\. 0\.25: beyond"),
        ({"linear.x": 1.0, "linear.y": 0.5}, r"linear\.y is 0\.5"),
    ],
)
def test_a_velocity_beyond_them_is_refused(twist: dict[str, float], text: str) -> None:
    with pytest.raises(RefusedError, match=text):
        check_twist(BASE, twist)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_velocity_that_is_no_number_is_refused_where_there_are_no_bounds(value: float) -> None:
    with pytest.raises(RefusedError, match=r"linear\.z is .*, expected a finite number"):
        check_twist(replace(CAR, min_turning_radius_m=0.0), {"linear.z": value})


def test_a_base_without_a_steering_turns_on_the_spot() -> None:
    check_twist(replace(CAR, min_turning_radius_m=0.0), {"angular.z": 1.0})
    with pytest.raises(RefusedError, match="on the spot"):
        check_twist(CAR, {"angular.z": 1.0})


def test_a_car_that_is_told_only_how_fast_drives_straight_on() -> None:
    check_twist(CAR, {"linear.x": 0.1})
    check_twist(CAR, {"linear.x": 0.1, "angular.z": 0.0})


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_car_takes_its_narrowest_turn_and_none_that_is_narrower(way: float) -> None:
    check_twist(CAR, {"linear.x": 0.5 * way, "angular.z": 1.0})
    check_twist(CAR, {"linear.x": 0.5 * (1.0 - 1e-9), "angular.z": way})
    with pytest.raises(RefusedError, match=r"radius 0\.5 m, expected at least 0\.5 m"):
        check_twist(CAR, {"linear.x": 0.5 * way * (1.0 - 1e-6), "angular.z": 1.0})


def test_a_velocity_with_a_header_is_held_to_the_steering_too(
    make_gate: Callable[..., Gate], ask: Callable[..., GateRequest]
) -> None:
    stamped: Any = replace(CAR, type="geometry_msgs/msg/TwistStamped")
    gate = make_gate(stamped)
    turn = {"twist": {"linear": {"x": 0.4}, "angular": {"z": 1.0}}}
    verdict = gate.check(ask(stamped, turn, simulated=True))
    assert (verdict.allowed, verdict.rule) == (False, "steering")
    wide = {"twist": {"linear": {"x": 0.6}, "angular": {"z": 1.0}}}
    assert gate.check(ask(stamped, wide)).may_send


def test_the_steering_of_what_is_no_velocity_is_not_asked_for(
    make_gate: Callable[..., Gate],
    ask: Callable[..., GateRequest],
    endpoints: dict[str, Endpoint],
) -> None:
    pose = replace(endpoints["pose"], min_turning_radius_m=1.0)
    assert make_gate(pose).check(ask(pose, {"poses": [{}]})).may_send
