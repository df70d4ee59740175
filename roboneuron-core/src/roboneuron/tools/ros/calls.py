"""Common parts of the derived tools' handlers: arguments, results, the gate's verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

from pydantic import Field

from roboneuron.server.tool import Arguments, Result
from roboneuron.server.verdict import Verdict

if TYPE_CHECKING:
    from trajectory_msgs.msg import JointTrajectory

Value = dict[str, object]
"""A ROS message in the form used by agents."""


class RobotCall(Arguments):
    """Arguments of a call for one robot's endpoint."""

    robot: str = Field(default="", description="Which robot.")


class PublishingCall(RobotCall):
    """Arguments of a call that publishes."""

    timeout_s: float = Field(default=5.0, ge=0, le=60, description="For a subscriber [s].")


class Judged(Result):
    """Result of a call that may be refused."""

    simulated: bool = Field(description="it was only a question; nothing was sent")
    allowed: bool
    rule: str = Field(description="simulated: the rule that would refuse")
    reason: str = Field(description="simulated: why")


class JudgedFields(TypedDict):
    """The fields of `Judged`."""

    simulated: bool
    allowed: bool
    rule: str
    reason: str


def verdict_fields(verdict: Verdict) -> JudgedFields:
    """The fields of `Judged` for a verdict."""
    return {
        "simulated": verdict.simulated,
        "allowed": verdict.allowed,
        "rule": verdict.rule,
        "reason": verdict.reason,
    }


def duration_s(trajectory: JointTrajectory) -> float:
    """Time from the start of a JointTrajectory to its last point [s]."""
    if not trajectory.points:
        return 0.0
    last = trajectory.points[-1].time_from_start
    return float(last.sec + last.nanosec * 1e-9)
