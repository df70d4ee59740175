"""Control's last word before it publishes: the limits, what they did in the status, and in the audit."""

from __future__ import annotations

import logging
from pathlib import Path
from time import time_ns
from typing import Any

from roboneuron.config import LimitsConfig
from roboneuron.contract import Controller, Hold, JointCommand, JointSample, PostureInspector, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.audit import FILE_NAME, AuditLog, AuditRecord
from roboneuron.gate.motion import Motion, MotionLimiter, Verdict, inspector_of, motion_rules
from roboneuron.modules.status import ModuleStatus

_RECORD_PERIOD_S = 1.0
"""A limit that keeps acting is recorded this often; every change is recorded at once, at most ten a second."""
_CHANGE_PERIOD_S = 0.1
log = logging.getLogger(__name__)


class MotionGuard:
    """Applies the limits of `[limits]` to one arm; used from the executor's thread.

    Attributes:
        follow, rest: see `MotionLimiter`: a command of the predecessor, and a hold where the arm is measured.
        close: closes the audit.

    Raises:
        ConfigurationError: the limits do not fit the robot.
    """

    def __init__(
        self,
        limits: LimitsConfig,
        profile: RobotProfile,
        controller: Controller,
        status: ModuleStatus,
        state: Path,
        *,
        immediate: bool,
        longest_s: float,
    ) -> None:
        is_checked = profile.collision is None or isinstance(controller, PostureInspector)
        if not is_checked:
            log.warning("The controller tells no distances: collisions of %s are not checked.", profile.name)
        status.set_value("collision_checked", is_checked and profile.collision is not None)
        self._limiter = MotionLimiter(
            motion_rules(limits, profile),
            profile,
            controller.forward,
            inspector_of(controller),
            immediate=immediate,
            longest_s=longest_s,
        )
        self._robot = profile.name
        self._status = status
        self._counts: dict[str, int] = {}
        self._audit = AuditLog(state / FILE_NAME, time_ns)
        self.follow, self.rest, self.close = self._limiter.follow, self._limiter.rest, self._audit.close
        self._recorded: tuple[str, ...] = ()
        self._recorded_s = 0.0

    def judge(self, command: JointCommand, joints: JointSample, now_s: float) -> JointCommand | Hold | None:
        """What to send instead of `command`: itself, a shorter one, a reason to hold, or None for nothing.

        The status tells both: `asked_*` and `sent_*`, `limited.<name>` how often a limit acted, `limit` the last one.
        """
        verdict = self._limiter.limit(command, joints, now_s)
        self._report("asked", verdict.asked)
        self._report("sent", verdict.sent)
        self._status.set_value("sent_share", verdict.share)
        for name in verdict.acted:
            self._counts[name] = self._counts.get(name, 0) + 1
            self._status.set_value(f"limited.{name}", self._counts[name])
        if verdict.reason:
            self._status.set_value("limit", verdict.reason)
        if verdict.reference_lost:
            self._counts["reference_lost"] = self._counts.get("reference_lost", 0) + 1
            self._status.set_value("reference_lost", self._counts["reference_lost"])
        if verdict.command is None:
            self._status.dropped.add(f"limit_{verdict.acted[-1]}")
        self._record(verdict, now_s)
        return verdict.command

    def _report(self, word: str, motion: Motion | None) -> None:
        if motion is None:
            return
        self._status.set_value(f"{word}_step_m", motion.step_m)
        self._status.set_value(f"{word}_step_rad", motion.step_rad)
        self._status.set_value(f"{word}_speed_m_s", motion.speed_m_s)
        self._status.set_value(f"{word}_joint_speed", motion.joint_speed)
        if motion.smallest_singular_value is not None:
            self._status.set_value(f"{word}_singular_value", motion.smallest_singular_value)

    def _record(self, verdict: Verdict, now_s: float) -> None:
        """One line in the audit when the limits begin to act, act otherwise, or go on acting."""
        outcome = _outcome(verdict)
        state = (outcome, *verdict.acted) if verdict.reason else ()
        since_s = now_s - self._recorded_s
        if not state or since_s < (_CHANGE_PERIOD_S if state != self._recorded else _RECORD_PERIOD_S):
            return
        self._recorded, self._recorded_s = state, now_s
        numbers: dict[str, Any] = {
            word: {name: round(value, 6) for name in Motion.__slots__ if (value := getattr(motion, name)) is not None}
            for word, motion in (("asked", verdict.asked), ("sent", verdict.sent))
            if motion is not None
        }
        record = AuditRecord(
            who="control",
            role="",
            tool="action",
            verdict=outcome,
            robot=self._robot,
            endpoint="action",
            rule=", ".join(verdict.acted) or (verdict.command.code if isinstance(verdict.command, Hold) else ""),
            reason=verdict.reason,
            arguments={**numbers, "counts": dict(self._counts)},
        )
        try:
            self._audit.write(record)
        except RefusedError as error:
            self._status.dropped.add("unrecorded")
            log.error("%s", error)


def _outcome(verdict: Verdict) -> str:
    if verdict.command is None:
        return "refused"
    return "held" if isinstance(verdict.command, Hold) else "scaled"
