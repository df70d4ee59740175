"""Commands of continuous joints, which drivers take differently beyond half a turn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron import JointSample, RefusedError
from roboneuron.direct_path.fields import load_type
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.joint_paths import check_joints

Limit = joint_space.JointLimit


def point(at_s: float, position: float) -> Any:
    made = load_type("trajectory_msgs/msg/JointTrajectoryPoint")(positions=[position])
    made.time_from_start.sec = int(at_s)
    return made


def trajectory(*points: Any) -> Any:
    return load_type("trajectory_msgs/msg/JointTrajectory")(joint_names=["a"], points=list(points))


def state(position: float) -> Any:
    return load_type("sensor_msgs/msg/JointState")(name=["a"], position=[position])


ENDLESS = {"a": Limit(velocity=20.0, acceleration=500.0, is_continuous=True)}
TURNS = {"a": Limit(lower=-3.0, upper=3.0, velocity=20.0, acceleration=500.0, is_continuous=True)}


def turned(at: float) -> JointSample:
    return JointSample(names=("a",), position=np.array([at]))


@pytest.mark.parametrize(
    ("limits", "start", "goal", "hint"),
    [
        (ENDLESS, 3.1, -3.1, "Write 3.18319, which is the same posture."),
        (ENDLESS, -3.08, 3.2, "Write -3.08319, which is the same posture."),
        (ENDLESS, 0.0, 6.3, "Write 0.0168147, which is the same posture."),
        (TURNS, 2.9, -2.9, "Put a point at 0 between."),
    ],
)
@pytest.mark.parametrize("as_state", [False, True])
def test_a_continuous_joint_is_turned_by_half_a_turn_at_a_time(
    limits: Mapping[str, Limit], start: float, goal: float, hint: str, as_state: bool
) -> None:
    command = state(goal) if as_state else trajectory(point(2.0, goal))
    with pytest.raises(RefusedError, match="a is continuous and would turn by") as caught:
        check_joints(limits, [command], turned(start))
    assert caught.value.hint == hint


@pytest.mark.parametrize(
    ("limits", "start", "goals"),
    [
        (ENDLESS, 3.1, [3.18319]),
        (ENDLESS, 20.0, [17.0]),
        (ENDLESS, 0.0, [3.14, 6.28, 9.42]),
        (TURNS, 2.9, [0.0, -2.9]),
        ({"a": replace(TURNS["a"], is_continuous=False)}, 2.9, [-2.9]),
    ],
)
def test_ways_that_all_drivers_take_alike_are_allowed(
    limits: Mapping[str, Limit], start: float, goals: list[float]
) -> None:
    points = [point(2.0 * i, goal) for i, goal in enumerate(goals, 1)]
    legs = check_joints(limits, [trajectory(*points)], turned(start))
    assert [leg.position.tolist() for leg in legs] == [[goal] for goal in goals]


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_no_joint_is_without_limits_at_infinity(value: float) -> None:
    with pytest.raises(RefusedError, match="position of a is"):
        check_joints(ENDLESS, [trajectory(point(1.0, value))], turned(0.0))
