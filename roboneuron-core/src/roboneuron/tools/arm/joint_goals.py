"""Arguments and result of move_joints; goals of joints: their range, turns, and time, and the
trajectory there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from pydantic import Field

from roboneuron.contract import JointSample
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.acceleration import shortest_s
from roboneuron.server.tool import Arguments, Result
from roboneuron.tools.arm.joint_rest import position_of

Limits = Mapping[str, joint_space.JointLimit]
_EASY, _EASY_ACCELERATION = 0.4, 0.5
"""Fractions of the velocity and acceleration limits used by a move without a given duration."""
_NEARLY = 0.95
"""Fraction of a joint's permitted velocity this close to its limit."""


class MoveJoints(Arguments):
    """Arguments of move_joints."""

    positions: dict[str, float] = Field(
        min_length=1, description="Target by joint, rad or m; other joints stay in place."
    )
    duration_s: float | None = Field(
        default=None, gt=0, description="Duration [s]; at a moderate speed if omitted."
    )


class JointMove(Result):
    """Measured motion of the arm."""

    robot: str
    position: dict[str, float] = Field(description="measured at the end [rad or m]")
    error: float = Field(description="largest distance from the target [rad or m]")
    duration_s: float
    simulated: bool
    allowed: bool
    reason: str
    holding: bool | None = Field(
        default=None, description="the hand holds something; null: unknown"
    )
    lost_on_the_way: bool = False
    hands: dict[str, bool | None] = Field(
        default_factory=dict,
        description="of several arms that were moved, by name: the hand holds something; "
        "`holding`: one of them does",
    )


def schema_of(limit: joint_space.JointLimit) -> dict[str, object]:
    """JSON schema of a position, which knows no infinite bounds."""
    ends = {"minimum": limit.lower, "maximum": limit.upper}
    return {"type": "number", **{key: end for key, end in ends.items() if math.isfinite(end)}}


def nearest_goals(
    goals: Mapping[str, float], joints: JointSample, limits: Limits
) -> dict[str, float]:
    """The goals, of continuous joints in the turns that are soonest reached. Raises
    NotReadyError.
    """
    return {
        name: limits[name].nearest(position_of(joints, name), goal) for name, goal in goals.items()
    }


def easy_s(goals: Mapping[str, float], joints: JointSample, limits: Limits) -> float:
    """Duration [s] at which every joint uses at most a fraction of its velocity limit. Raises
    NotReadyError.
    """
    needed = [0.5]
    for name, goal in goals.items():
        limit, start = limits[name], position_of(joints, name)
        distance, fastest = abs(goal - start), limit.fastest(goal, goal > start)
        needed.append(distance / min(_EASY * limit.velocity, _NEARLY * fastest or limit.velocity))
        needed.append(shortest_s(distance, _EASY_ACCELERATION * limit.acceleration))
    return max(needed)


def trajectory_to(
    goals: Mapping[str, float], duration_s: float, joints: JointSample, limits: Limits
) -> object:
    """Create a JointTrajectory of one point, or of two where a continuous joint goes more than half
    a turn: its driver may take the shorter way to a point.
    """
    from builtin_interfaces.msg import Duration  # heavy
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # heavy

    way = [(position_of(joints, name), float(goal)) for name, goal in goals.items()]
    is_far = any(
        limits[name].is_continuous and abs(end - start) > math.pi
        for name, (start, end) in zip(goals, way, strict=True)
    )
    points = []
    for share in (0.5, 1.0) if is_far else (1.0,):
        seconds, nanoseconds = divmod(round(share * duration_s * 1e9), 1_000_000_000)
        point = JointTrajectoryPoint(
            positions=[end - (1.0 - share) * (end - start) for start, end in way],
            time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
        )
        points.append(point)
    return JointTrajectory(joint_names=list(goals), points=points)
