"""A planar arm of two joints with kinematics in two lines."""

from __future__ import annotations

import math

import numpy as np

from roboneuron.contract import (
    GripperProfile,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    Pose,
    Posture,
    Proximity,
    RobotProfile,
)
from roboneuron.contract.rotation import matrix_from_rotvec, quaternion_from_matrix
from roboneuron.gate.motion import LIMITS, LimitedCommand, MotionLimiter, MotionRules

NAMES = ("a", "b")
HOLD = dict.fromkeys(LIMITS, "hold")
SCALE = dict.fromkeys(LIMITS, "scale")
START = np.array([0.3, 1.2])
STEP_S = 0.1


def profile(*, braking: bool = False) -> RobotProfile:
    return RobotProfile(
        name="planar",
        arm_joints=NAMES,
        limits=JointLimits(
            lower=np.array([-2.0, 0.1]),
            upper=np.array([2.0, 2.5]),
            velocity=np.array([1.0, 1.5]),
            acceleration=np.array([4.0, 4.0]),
            effort=np.ones(2),
            braking_offset=np.array([0.1, 0.1]) if braking else None,
            braking_deceleration=np.array([2.0, 3.0]) if braking else None,
        ),
        gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
    )


def inspect(joints: JointSample) -> Posture:
    """Two links of 0.5 m in the x-z plane; straight (b = 0) is singular; "touching" if folded
    beyond 2.4 rad.
    """
    a, b = joints.position[:2].tolist()
    x, z = 0.5 * math.cos(a) + 0.5 * math.cos(a + b), 0.5 * math.sin(a) + 0.5 * math.sin(a + b)
    turn = matrix_from_rotvec(np.array([0.0, -(a + b), 0.0]))
    return Posture(
        pose=Pose(position_m=np.array([x, 0.0, z]), quaternion_xyzw=quaternion_from_matrix(turn)),
        smallest_singular_value=0.3 * abs(math.sin(b)),
        near=(Proximity(first="link1", second="link2", distance_m=(2.4 - b) / 10.0, least_m=0.0),)
        if b > 2.4
        else (),
    )


def forward(joints: JointSample) -> Pose:
    return inspect(joints).pose


def place(position: np.ndarray) -> np.ndarray:
    return inspect(sample(position)).pose.position_m


def sample(position: np.ndarray) -> JointSample:
    return JointSample(names=NAMES, position=np.asarray(position, dtype=float))


def command(position: np.ndarray, duration_s: float = STEP_S) -> JointCommand:
    return JointCommand(
        names=NAMES, position=np.asarray(position, dtype=float), duration_s=duration_s
    )


def limiter(rules: MotionRules | None = None, **options: bool) -> MotionLimiter:
    braking = options.pop("braking", False)
    return MotionLimiter(
        rules or MotionRules(reactions=SCALE), profile(braking=braking), forward, inspect, **options
    )


def sent(verdict: LimitedCommand) -> JointCommand:
    assert isinstance(verdict.command, JointCommand), verdict
    return verdict.command


def hold(verdict: LimitedCommand) -> Hold:
    assert isinstance(verdict.command, Hold), verdict
    assert verdict.sent is None
    return verdict.command
