"""Entries of the allow list, and the role required for each kind of endpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.gate.motion.path_limits import PathLimiter
from roboneuron.gate.motion.rules import MotionRules
from roboneuron.gate.roles import Role

ROLE_BY_KIND = {
    "read": Role.VIEWER,
    "publish": Role.OPERATOR,
    "service": Role.OPERATOR,
    "action": Role.OPERATOR,
}
"""Required role by endpoint kind. Everything except reading may move the robot."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AllowedEndpoint:
    """An entry of the allow list.

    Attributes:
        robot: configured name of the robot.
        endpoint: the endpoint with its limits, already tightened by the configuration.
        profile: the robot's profile; None for endpoints without a robot.
        clamp: field paths whose values are moved to the nearest bound instead of refused.
        nonfinite: field paths (without indices) that may hold NaN and infinities.
        topic: absolute name; entries of one topic and kind share its rate. Empty: the entry has a
            separate rate.
        rules: the limits of `[limits]` for the robot; None for its profile's only.
        path: returns the checker of an arm's joint motions in task space; None for robots without a
            TCP. If it raises RoboNeuronError, the motion is refused.
    """

    robot: str
    endpoint: Endpoint
    profile: RobotProfile | None = None
    clamp: frozenset[str] = frozenset()
    nonfinite: frozenset[str] = frozenset()
    topic: str = ""
    rules: MotionRules | None = None
    path: Callable[[], PathLimiter] | None = None
