"""Goals of joints: their range, turns, and time, and the trajectory there."""

from __future__ import annotations

import math
from collections.abc import Mapping

from roboneuron.contract import JointSample
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.acceleration import shortest_s
from roboneuron.tools.arm.joint_rest import position_of

Limits = Mapping[str, joint_space.JointLimit]
_EASY, _EASY_ACCELERATION = 0.4, 0.5
"""Fractions of the velocity and acceleration limits used by a move without a given duration."""
_NEARLY = 0.95
"""Fraction of a joint's permitted velocity this close to its limit."""


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
