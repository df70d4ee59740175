"""The check of places in front of a driver, by a table of limits and ways; on a gantry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gantry import ARM, Gantry, at, profile, to

from roboneuron.contract import CollisionProfile, JointCommand, JointSample, Obstacle
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import DriverPaths, MotionRules
from roboneuron.gate.motion.path_limits import PathLimiter

NOW_S = 100.0
ZONE = Obstacle(name="box", lower_m=np.array([0.5, -2.0, -2.0]), upper_m=np.array([2.0, 2.0, 2.0]))
LIMITS: Mapping[str, dict[str, Any]] = {
    "zone": {"zones": (ZONE,)},
    "workspace": {"upper_m": np.array([0.5, 9.0, 9.0])},
    "collision": {},
}
"""Each forbids the TCP to be at x from 0.5 to 2 m."""


def paths(limit: str, start: JointSample | None) -> DriverPaths:
    walled = limit == "collision"
    gantry = Gantry((lambda x: 0.49 + 0.01 - x) if walled else None)
    robot = replace(profile(), collision=CollisionProfile()) if walled else profile()
    rules = MotionRules(reactions={}, **LIMITS[limit])
    made = DriverPaths(PathLimiter(rules, robot, gantry.inspect), robot)
    made.measure(start, NOW_S)
    return made


def rule(made: DriverPaths, *commands: Any) -> str:
    """The rule that refuses a command; empty if it passes."""
    try:
        made.limit(commands)
    except RefusedError as error:
        return error.rule
    return ""


@pytest.mark.parametrize("limit", LIMITS)
@pytest.mark.parametrize(
    ("start", "ends", "is_free"),
    [
        (0.0, (0.4,), True),
        (0.0, (0.6,), False),
        (0.0, (0.2, 0.4), True),
        (0.0, (0.2, 0.6), False),
        (0.0, (0.6, 0.2), False),
        (0.6, (0.55,), True),
        (0.6, (0.3,), True),
        (0.6, (0.61,), False),
        (0.6, (0.55, 0.6), False),
    ],
)
def test_a_way_into_a_forbidden_place_is_refused_and_one_out_of_it_passes(
    limit: str, start: float, ends: tuple[float, ...], is_free: bool
) -> None:
    made = paths(limit, at(start))
    assert rule(made, *(to(end) for end in ends)) == ("" if is_free else f"limit_{limit}")


def test_a_way_through_a_zone_is_refused_though_both_ends_are_free() -> None:
    assert rule(paths("zone", at(0.4)), to(2.2)) == "limit_zone"


@pytest.mark.parametrize("limit", LIMITS)
def test_a_hold_passes_wherever_the_arm_was_measured_within_a_second(limit: str) -> None:
    made = paths(limit, at(0.62))
    made.measure(at(0.61), NOW_S + 0.5)
    assert rule(made, to(0.61)) == ""
    assert rule(made, to(0.62)) == ""
    assert rule(made, to(0.62 + 1e-9)) == f"limit_{limit}", "exactly, or it would creep"
    assert rule(made, to(0.62), to(0.62)) == f"limit_{limit}", "a path is no hold"
    made.measure(at(0.61), NOW_S + 1.4)
    assert rule(made, to(0.62)) == f"limit_{limit}"


def test_unknown_joints_refuse_every_command() -> None:
    assert rule(paths("zone", None), to(0.1)) == "not_measured"
    made = paths("zone", at(0.0))
    made.measure(None, NOW_S)
    assert rule(made, to(0.1)) == "not_measured"


UNMEASURED = {"absent": (), "not finite": (math.nan,)}


@pytest.mark.parametrize("value", UNMEASURED.values(), ids=UNMEASURED)
@pytest.mark.parametrize(
    ("joint", "x", "refused"),
    [
        ("finger", 0.4, ""),
        ("finger", 0.6, "limit_zone"),
        ("turn", 0.4, "limit_kinematics"),
        ("other", 0.4, "limit_kinematics"),
    ],
)
def test_of_joints_that_are_not_measured_only_a_gripper_may_be_commanded(
    value: tuple[float, ...], joint: str, x: float, refused: str
) -> None:
    names = tuple(name for name in ARM if name != joint)
    start = (0.0,) * len(names)
    known = JointSample(
        names=(*names, joint) if value else names, position=np.array([*start, *value])
    )
    made = paths("zone", known)
    targets = dict.fromkeys(names, 0.0) | {joint: 0.0, "x": x}
    command = JointCommand(
        names=tuple(targets), position=np.array(list(targets.values())), duration_s=0.1
    )
    assert not made.is_short([command]), "the way of x is long, whatever the others do"
    assert rule(made, command) == refused


def test_a_gripper_that_is_not_measured_is_commanded_alone() -> None:
    made = paths("collision", at(0.0))
    finger = JointCommand(names=("finger",), position=np.array([0.04]), duration_s=0.1)
    assert made.is_short([finger])
    assert made.limit([finger]) == ([finger], "")


def test_a_hold_may_command_a_gripper_that_is_not_measured() -> None:
    made = paths("zone", at(0.62))
    held = to(0.62)
    with_finger = JointCommand(
        names=(*held.names, "finger"), position=np.append(held.position, 0.04), duration_s=0.1
    )
    assert rule(made, with_finger) == ""


def test_long_ways_are_told_from_short_ones() -> None:
    made = paths("zone", at(0.0))
    assert made.is_short([to(0.1)])
    assert made.is_short([to(0.05), to(0.1)])
    assert not made.is_short([to(0.4)])
    assert not made.is_short([to(0.05), to(0.0)] * 4)


def test_a_check_ends_when_nobody_needs_it_any_more() -> None:
    made, asked = paths("zone", at(0.0)), iter([True, False])
    made.limit([to(0.1), to(0.6)], lambda: next(asked))
    assert rule(made, to(0.1), to(0.6)) == "limit_zone"


def test_an_arm_that_moved_during_a_check_is_checked_from_where_it_is() -> None:
    made = paths("zone", at(0.0))

    def move() -> bool:
        made.measure(at(2.2), NOW_S)
        return True

    with pytest.raises(RefusedError) as refusal:
        made.limit([to(0.1)], move)
    assert refusal.value.rule == "limit_zone"


def test_other_rules_hold_from_the_next_command_on() -> None:
    made = paths("zone", at(0.0))
    made.use(MotionRules(reactions={}))
    assert rule(made, to(0.6)) == ""
    made.use(MotionRules(reactions={}, min_height_m=0.2))
    made.measure(at(0.0, 0.3), NOW_S)
    assert rule(made, to(0.0, 0.1)) == "limit_height"


@pytest.mark.parametrize(
    ("limits", "moved", "factors"),
    [
        ({"max_speed_m_s": 1.0}, (0.1, 0.3), [1.0, 2.0]),
        ({"max_speed_m_s": 2.0}, (0.1, 0.3), [1.0, 1.0]),
        ({"max_speed_m_s": 0.5}, (0.1, 0.1), [2.0, 1.0]),
    ],
)
def test_a_tcp_that_would_be_too_fast_gets_its_time(
    limits: Mapping[str, float], moved: tuple[float, ...], factors: list[float]
) -> None:
    made = paths("zone", at(0.0))
    made.use(MotionRules(reactions={}, **limits))
    limited, reason = made.limit([to(x) for x in moved])
    assert [one.duration_s for one in limited] == pytest.approx([0.1 * by for by in factors])
    assert bool(reason) == (max(factors) > 1.0)
    assert [float(one.position[0]) for one in limited] == list(moved)
