"""Entries of the allow list, and the role that each kind of endpoint needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rn_standard.direct_path.path_limits import PathLimiter
from roboneuron import Endpoint, RobotProfile
from roboneuron.feature import MotionRules, Role

ROLE_BY_KIND = {
    "read": Role.VIEWER,
    "publish": Role.OPERATOR,
    "service": Role.OPERATOR,
    "action": Role.OPERATOR,
}
"""Least role by endpoint kind. Everything but reading may move the robot."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AllowedEndpoint:
    """An entry of the allow list.

    Attributes:
        robot: name under which the robot is configured.
        endpoint: what may be used and how, already tightened by the configuration.
        profile: the robot's facts; None for endpoints that belong to no robot.
        clamp: field paths whose values are moved to the nearest bound instead of refused.
        nonfinite: field paths (without indices) that may hold NaN and infinities.
        topic: absolute name; entries of one topic and kind share its rate. Empty: the entry has a
            rate of its own.
        rules: the numbers of `[limits]` for the robot; None for its profile's alone.
        path: gives what judges joint motions of an arm in task space; None for robots without a
            TCP. Raises RoboNeuronError when it cannot be had, and the motion is refused.
    """

    robot: str
    endpoint: Endpoint
    profile: RobotProfile | None = None
    clamp: frozenset[str] = frozenset()
    nonfinite: frozenset[str] = frozenset()
    topic: str = ""
    rules: MotionRules | None = None
    path: Callable[[], PathLimiter] | None = None
