"""Result of run_task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from rn_standard.tasks.runner import TaskEnd
from rn_standard.tasks.snapshot import ArmSnapshot, Snapshot
from rn_standard.tasks.task_watch import MonitorReport, Says
from roboneuron import Result


class MonitorWord(Result):
    """Last word of the monitor that watched a task; unknown values are null."""

    name: str
    says: Says
    reason: str
    agrees: bool | None = Field(default=None, description="with the predicate")
    value: float | None = Field(default=None, description="probability of success")
    progress: float | None = None
    failure: float | None = Field(default=None, description="probability of a failed attempt")
    answers: int = Field(description="observations that it was asked about")


class FinalArm(Result):
    """Final state of one arm, the first of several; unmeasured values are null."""

    tcp_position_m: list[float] | None = Field(default=None, description="base frame")
    tcp_quaternion_xyzw: list[float] | None = None
    gripper_open: float | None = Field(default=None, description="0 closed .. 1 open")


class FinalState(FinalArm):
    """Measured state at the end; unmeasured values are null."""

    joints: dict[str, float] | None = Field(default=None, description="rad or m")
    arms: dict[str, FinalArm] = Field(default_factory=dict, description="of several, by name")
    still_s: float | None = Field(default=None, description="time since a joint last moved")


class TaskResult(Result):
    """Result of a task; images from before and after accompany it, in this order."""

    outcome: Literal["succeeded", "failed", "timed_out", "stopped", "unclear", "taken_over"] = (
        Field(
            description="succeeded: the predicate was true, also with the arm at rest; failed: no "
            "attempt succeeded; timed_out: the last one ran out of time; stopped: by someone; "
            "unclear: it cannot be "
            "judged, see the images"
        )
    )
    attempts: int = Field(description="0: it was done before anything moved")
    reason: str
    images_before: int = Field(description="number of images from before, which come first")
    images_after: int
    state: FinalState
    ended_with: str = Field(
        description="what was done at the end: on_end, or why that was not possible"
    )
    took_s: float
    others_moved: dict[str, float] | None = Field(
        default=None, description="objects that it was not about: distance [m]; null: not seen"
    )
    monitor: MonitorWord | None = Field(
        default=None, description="what the configured monitor says beside the predicate"
    )


def task_result(end: TaskEnd, ended_with: str) -> TaskResult:
    return TaskResult(
        outcome=end.outcome.value,
        attempts=end.attempts,
        reason=told_reason(end.reason, end.others_moved),
        images_before=len(end.before),
        images_after=len(end.after),
        state=_state(end.state),
        ended_with=ended_with,
        took_s=round(end.took_s, 3),
        others_moved=None if end.others_moved is None else dict(end.others_moved),
        monitor=None if end.monitor is None else _word(end.monitor),
    )


def told_reason(reason: str, others_moved: Mapping[str, float] | None) -> str:
    """The reason as a sentence, with what was pushed meanwhile."""
    pushed = [f"{name} by {by_m * 100:.1f} cm" for name, by_m in (others_moved or {}).items()]
    return f"{reason}. Moved meanwhile: {', '.join(pushed)}." if pushed else f"{reason}."


def _word(report: MonitorReport) -> MonitorWord:
    return MonitorWord(
        name=report.name,
        says=report.says,
        reason=report.reason,
        agrees=report.agrees,
        value=_rounded(report.value),
        progress=_rounded(report.progress),
        failure=_rounded(report.failure),
        answers=report.answers,
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _arm_state(arm: ArmSnapshot) -> FinalArm:
    tcp, opening = arm.tcp, arm.gripper_open
    return FinalArm(
        tcp_position_m=None if tcp is None else [round(float(v), 4) for v in tcp.position_m],
        tcp_quaternion_xyzw=None
        if tcp is None
        else [round(float(v), 4) for v in tcp.quaternion_xyzw],
        gripper_open=None if opening is None else round(opening, 3),
    )


def _state(snapshot: Snapshot) -> FinalState:
    return FinalState(
        **_arm_state(snapshot.of_arm("")).model_dump(),
        arms={name: _arm_state(arm) for name, arm in snapshot.arms.items()},
        joints=None
        if snapshot.joints is None
        else {name: round(v, 4) for name, v in snapshot.joints.items()},
        still_s=None if snapshot.still_s is None else round(snapshot.still_s, 2),
    )
