"""What control would make of actions is computed with its own limits; dry runs of move_ee are
judged by it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    EE_DELTA,
    Action,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
)
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.tools.arm.prediction import ArmControl, PredictedArm

PROFILE = RobotProfile(name="gantry", arm_joints=("x", "y"))
PANE = {"name": "pane", "lower_m": [0.095, -1.0, 0.0], "upper_m": [0.105, 1.0, 1.0]}


class Gantry:
    """Two slides; the TCP is where they are."""

    def __init__(self, duration_s: float = 0.1) -> None:
        self.duration_s = duration_s
        self.is_closed = False

    def load(self) -> None:
        pass

    def forward(self, joints: JointSample) -> Pose:
        return Pose(
            position_m=np.array([*joints.position[:2], 0.3]),
            quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        )

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        if action.translation_m[2]:
            return Hold(code="no_solution", reason="It has no third axis.")
        return JointCommand(
            names=("x", "y"),
            position=joints.position + action.translation_m[:2],
            duration_s=self.duration_s,
        )

    def close(self) -> None:
        self.is_closed = True


def predicted(gantry: Gantry, longest_s: float = 1.0, **limits: object) -> PredictedArm:
    rules = motion_rules(LimitsConfig.model_validate(limits), PROFILE)

    def inspect(joints: JointSample) -> Posture:
        return Posture(pose=gantry.forward(joints))

    limiter = MotionLimiter(rules, PROFILE, gantry.forward, inspect, longest_s=longest_s)
    control = ArmControl(gantry, limiter, PROFILE, rules)
    return PredictedArm(control, JointSample(names=("x", "y"), position=np.zeros(2)))


def move(x: float, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    return np.array([x, y, z, 0.0, 0.0, 0.0, 1.0])


def test_the_arm_follows_actions_one_by_one() -> None:
    arm = predicted(Gantry())
    for _ in range(5):
        arm.follow(EE_DELTA, move(0.03, 0.01), 0.1)
        assert arm.held == ""
    np.testing.assert_allclose(arm.poses()[0].position_m, [0.15, 0.05, 0.3])


def test_a_slow_command_is_followed_for_the_time_of_the_step_only() -> None:
    arm = predicted(Gantry(duration_s=0.2))
    arm.follow(EE_DELTA, move(0.03), 0.1)
    np.testing.assert_allclose(arm.poses()[0].position_m, [0.015, 0.0, 0.3])


def test_a_zone_between_start_and_end_holds_the_arm_before_it() -> None:
    arm = predicted(Gantry(), zones=[PANE])
    for _ in range(10):
        arm.follow(EE_DELTA, move(0.03), 0.1)
    assert "would enter 'pane'" in arm.held
    assert arm.poses()[0].position_m[0] < 0.095
    arm.follow(EE_DELTA, move(-0.02), 0.1)
    assert arm.held == ""


def test_what_the_controller_refuses_and_what_lasts_too_long_holds() -> None:
    arm = predicted(Gantry())
    arm.follow(EE_DELTA, move(0.0, 0.0, 0.1), 0.1)
    assert arm.held == "It has no third axis."
    slow = predicted(Gantry(duration_s=3.0))
    slow.follow(EE_DELTA, move(0.03), 0.1)
    assert "lasts 3 s" in slow.held
    np.testing.assert_allclose(slow.poses()[0].position_m, [0.0, 0.0, 0.3])


def test_closing_releases_the_controller() -> None:
    gantry = Gantry()
    predicted(gantry).close()
    assert gantry.is_closed
