"""What is asked of the gate and what it answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rn_standard.direct_path.path_limits import PathLimiter
from roboneuron import Endpoint, JointSample, RobotProfile
from roboneuron.feature import OPERATOR, VIEWER, MotionRules

ROLE_BY_KIND = {"read": VIEWER, "publish": OPERATOR, "service": OPERATOR, "action": OPERATOR}
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


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class GateRequest:
    """One thing an agent wants to do with one endpoint.

    Attributes:
        who: which client, as the transport knows it.
        role: one of `roboneuron.gate.ROLES`.
        tool: the tool's name.
        robot, endpoint: names in the allow list.
        messages: the encoded message, or every step of a sequence; empty for a read.
        arguments: what the agent sent, for the audit.
        joints: newest measured joints; needed by endpoints that are `joint_limited`.
        durations_s: how long each message lasts [s], where that is known; joints must get there
            within that time.
        send_at_s: when each message is to be sent, in seconds from now; empty when `messages` go
            out at once.
        predict: computes a motion that `messages` do not hold, for a dry run; raises RefusedError,
            best a LimitError, when it would not come to its end.
        dry_run: only answer what would happen.
        repeated: a repetition that belongs to an earlier request; does not count against the rate.
    """

    who: str
    role: str
    tool: str
    robot: str
    endpoint: str
    messages: tuple[Any, ...] = ()
    arguments: Mapping[str, Any] = field(default_factory=dict)
    joints: JointSample | None = None
    durations_s: tuple[float, ...] = ()
    send_at_s: tuple[float, ...] = ()
    predict: Callable[[], None] | None = None
    dry_run: bool = False
    repeated: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Clamp:
    """A value that was moved to a bound: where, what was asked, what is sent."""

    path: str
    asked: float
    sent: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """The gate's answer.

    Attributes:
        allowed: nothing speaks against it.
        dry_run: it was only a question; nothing may be sent even if allowed.
        reason: why not; empty when allowed.
        rule: the rule that refused ("allow_list", "role", "type", "finite", "bounds", "steering",
            "joints", the name of a limit of `[limits]`, "path", "rate", "emergency_stop", "audit");
            empty when allowed.
        clamped: values that were changed in the messages.
    """

    allowed: bool
    dry_run: bool = False
    reason: str = ""
    rule: str = ""
    clamped: tuple[Clamp, ...] = ()

    @property
    def may_send(self) -> bool:
        """Whether the messages are to be sent now."""
        return self.allowed and not self.dry_run
