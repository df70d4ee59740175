"""Two gantries behind one limiter: the TCP limits hold for each, with one scale for both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gantry
import numpy as np
import pytest
from gantry import HOLD, SCALE, STEP_S, hold, sent

from roboneuron.contract import (
    ArmProfile,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    Obstacle,
    Pose,
    Posture,
    Proximity,
    RobotProfile,
)
from roboneuron.gate.motion import LimitedCommand, MotionLimiter, MotionRules
from roboneuron.gate.motion.path import levers_m

NAMES = tuple(f"{arm}_{joint}" for arm in ("left", "right") for joint in gantry.ARM)
ARMS = tuple(
    ArmProfile(name=arm, joints=NAMES[i : i + 3], base_link=f"{arm}_base", tcp_link=f"{arm}_tcp")
    for i, arm in ((0, "left"), (3, "right"))
)
PAIR = RobotProfile(
    name="gantries",
    arm_joints=NAMES,
    limits=JointLimits(
        lower=np.full(6, -3.0),
        upper=np.full(6, 3.0),
        velocity=np.full(6, 1e2),
        acceleration=np.full(6, 1e3),
        effort=np.ones(6),
    ),
    arms=ARMS,
)


class Gantries:
    """Two gantries whose TCPs must stay 10 mm apart along x."""

    def __init__(self, told: int = 2, singular: tuple[float, float] | None = None) -> None:
        self._one = gantry.Gantry()
        self._told, self._singular = told, singular

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        parts = [JointSample(names=gantry.ARM, position=joints.position[i : i + 3]) for i in (0, 3)]
        return tuple(map(self._one.forward, parts))

    def forward(self, joints: JointSample) -> Pose:
        return self.poses(joints)[0]

    def inspect(self, joints: JointSample) -> Posture:
        values = self._singular or (None, None)
        left, right = (
            Posture(pose=pose, smallest_singular_value=value)
            for pose, value in zip(self.poses(joints), values, strict=True)
        )
        distance_m = abs(float(left.pose.position_m[0] - right.pose.position_m[0]))
        pair = Proximity(first="left_tcp", second="right_tcp", distance_m=distance_m, least_m=0.01)
        return replace(
            left, near=(pair,) if distance_m < 0.01 else (), others=(right,)[: self._told - 1]
        )


def limiter(
    rules: MotionRules = SCALE, arms: Gantries | None = None, **values: Any
) -> MotionLimiter:
    both = arms or Gantries()
    return MotionLimiter(
        rules, replace(PAIR, **values), both.forward, both.inspect, poses=both.poses
    )


def at(left_x: float = 0.0, right_x: float = 1.0, left_z: float = 0.0, right_z: float = 0.0) -> Any:
    return JointSample(names=NAMES, position=np.array([left_x, left_z, 0, right_x, right_z, 0]))


def to(*values: float, duration_s: float = STEP_S) -> JointCommand:
    return JointCommand(names=NAMES, position=at(*values).position, duration_s=duration_s)


def moved(verdict: LimitedCommand, start: JointSample) -> list[float]:
    return [round(float(value), 6) for value in sent(verdict).position - start.position]


BOX = Obstacle(name="box", lower_m=np.array([1.2, -1, -1]), upper_m=np.array([1.4, 1, 1]))


@pytest.mark.parametrize(
    ("rules", "target", "name"),
    [
        ({"max_step_m": 0.05}, (0.0, 1.1), "step"),
        ({"max_speed_m_s": 0.5}, (0.0, 1.1), "speed"),
        ({"upper_m": np.array([1.05, 9.0, 9.0])}, (0.0, 1.1), "workspace"),
        ({"min_height_m": -0.05}, (0.0, 1.0, 0.0, -0.1), "height"),
        ({"zones": (BOX,)}, (0.0, 1.3), "zone"),
    ],
)
def test_a_limit_of_the_tcp_holds_for_the_second_arm(
    rules: dict[str, Any], target: tuple[float, ...], name: str
) -> None:
    verdict = limiter(replace(HOLD, **rules)).limit(to(*target), at(), 0.0)
    hold(verdict, f"limit_{name}", "right: The TCP would")


def test_a_singularity_of_the_second_arm_is_one() -> None:
    rules = replace(HOLD, min_singular_value=0.1)
    verdict = limiter(rules, Gantries(singular=(0.5, 0.05))).limit(to(0.1), at(), 0.0)
    hold(verdict, "limit_singularity", "right: The smallest singular value would be 0.05")


def test_both_arms_are_scaled_alike() -> None:
    verdict = limiter(replace(SCALE, max_step_m=0.05)).limit(to(0.04, 1.2), at(), 0.0)
    assert moved(verdict, at()) == [0.0098, 0.0, 0.0, 0.049, 0.0, 0.0]


def test_the_numbers_told_are_the_largest_of_both() -> None:
    verdict = limiter().limit(to(0.04, 1.02), at(), 0.0)
    assert verdict.sent is not None
    assert verdict.sent.step_m == pytest.approx(0.04)
    assert limiter().limit(to(0.01, 1.02), at(), 0.0).sent.step_m == pytest.approx(0.02)  # type: ignore[union-attr]


def test_arms_come_no_nearer_than_their_links_may() -> None:
    start = at(0.0, 0.05)
    verdict = limiter().limit(to(0.03, 0.02), start, 0.0)
    left_x, right_x = sent(verdict).position[[0, 3]]
    assert verdict.acted == ("collision",)
    assert right_x - left_x >= 0.01
    assert verdict.reason.startswith("left_tcp and right_tcp would be")


def test_a_controller_that_tells_of_too_few_arms_is_not_believed() -> None:
    verdict = limiter(arms=Gantries(told=1)).limit(to(0.01), at(), 0.0)
    assert isinstance(verdict.command, Hold)
    assert verdict.command.code == "unsafe_command"
    assert "tells the postures of 1 arms, the robot has 2" in verdict.reason


def test_an_immediate_command_is_scaled_by_the_arm_that_is_farthest_behind() -> None:
    """The right arm lags 80 mm behind its setpoint, the left one makes the larger new step."""
    both = Gantries()
    rules = replace(SCALE, max_speed_m_s=0.5)
    judge = MotionLimiter(rules, PAIR, both.forward, both.inspect, poses=both.poses, immediate=True)
    judge.follow(to(0.0, 1.08), at(), 0.0)
    verdict = judge.limit(to(0.06, 1.081), at(), 0.1)
    assert "speed" in verdict.acted
    assert moved(verdict, at(0.0, 1.08)) == [0.0] * 6, "neither goes on"


def test_the_joints_of_each_arm_have_their_levers() -> None:
    urdf = "".join(
        f'<joint name="{arm}_{joint}" type="revolute"><parent link="{arm}_{parent}"/>'
        f'<child link="{arm}_{child}"/><origin xyz="0 0 {length}"/></joint>'
        for arm, length in (("left", 0.5), ("right", 0.25))
        for joint, parent, child in (("x", "base", "l1"), ("z", "l1", "tcp"))
    )
    robot = replace(PAIR, urdf=f"<robot>{urdf}</robot>")
    assert levers_m(robot) == pytest.approx(
        {"left_z": 0.1, "left_x": 0.6, "right_z": 0.1, "right_x": 0.35}
    )
