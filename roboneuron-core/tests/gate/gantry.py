"""A gantry whose joints are its TCP position, and the limiter on it, for verdicts with
hand-computed numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

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
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion import LIMITS, LimitedCommand, MotionLimiter, MotionRules

ARM = ("x", "z", "turn")
SCALE = MotionRules(reactions=dict.fromkeys(LIMITS, "scale"))
HOLD = MotionRules(reactions=dict.fromkeys(LIMITS, "hold"))
STEP_S = 0.1
Near = Callable[[float], float]


def profile(acceleration: float = 1e3, velocity: float = 1e2, **values: Any) -> RobotProfile:
    limits = JointLimits(
        lower=np.full(3, -3.0),
        upper=np.full(3, 3.0),
        velocity=np.full(3, velocity),
        acceleration=np.full(3, acceleration),
        effort=np.ones(3),
    )
    gripper = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
    return RobotProfile(name="gantry", arm_joints=ARM, limits=limits, gripper=gripper, **values)


class Gantry:
    """Two slides along x and z and a turn about z; records the requested postures.

    `wall_m` gives the distance of the TCP from a wall by its x; the wall is near below 10 mm.
    """

    def __init__(self, wall_m: Near | None = None) -> None:
        self.asked: list[JointSample] = []
        self.wall_m = wall_m

    def forward(self, joints: JointSample) -> Pose:
        self.asked.append(joints)
        if joints.names[:3] != ARM:
            raise UnsafeError("The gantry is not measured.")
        x, z, turn = joints.position[:3].tolist()
        half = turn / 2.0
        return Pose(
            position_m=np.array([x, 0.0, z]),
            quaternion_xyzw=np.array([0, 0, math.sin(half), math.cos(half)]),
        )

    def inspect(self, joints: JointSample) -> Posture:
        pose = self.forward(joints)
        if self.wall_m is None:
            return Posture(pose=pose)
        distance_m = self.wall_m(float(pose.position_m[0]))
        pair = Proximity(first="hand", second="wall", distance_m=distance_m, least_m=0.01)
        return Posture(pose=pose, near=(pair,) if distance_m < 0.01 else ())

    def places(self) -> list[float]:
        """x of each posture requested since the last call."""
        found = [round(float(joints.position[0]), 6) for joints in self.asked]
        self.asked.clear()
        return found


def limiter(
    rules: MotionRules = SCALE,
    robot: RobotProfile | None = None,
    gantry: Gantry | None = None,
    **options: Any,
) -> MotionLimiter:
    arm = gantry or Gantry()
    return MotionLimiter(rules, robot or profile(), arm.forward, arm.inspect, **options)


def at(*position: float) -> JointSample:
    return JointSample(names=ARM, position=np.array([*position, 0.0, 0.0, 0.0][:3]))


def to(*position: float, duration_s: float = STEP_S) -> JointCommand:
    return JointCommand(names=ARM, position=at(*position).position, duration_s=duration_s)


def sent(verdict: LimitedCommand) -> JointCommand:
    assert isinstance(verdict.command, JointCommand), verdict
    return verdict.command


def place(verdict: LimitedCommand) -> list[float]:
    return sent(verdict).position.tolist()


def hold(verdict: LimitedCommand, name: str, reason: str = "") -> None:
    assert isinstance(verdict.command, Hold), verdict
    assert verdict.command.code == name
    assert verdict.command.reason == verdict.reason
    assert reason in verdict.reason
    assert verdict.reason
    assert verdict.sent is None
    assert verdict.share == 0.0


def speed_m_s(judge: MotionLimiter, x: float, measured: JointSample, now_s: float) -> float:
    """TCP speed of a command to x within 0.1 s; it reveals the setpoint."""
    verdict = judge.limit(to(x), measured, now_s)
    assert verdict.asked is not None
    return verdict.asked.speed_m_s
