"""Which joint states control believes, and its last word before it publishes: the limits, and what
they did.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from time import time_ns
from typing import Any

import numpy as np

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    Controller,
    Hold,
    JointCommand,
    JointSample,
    PostureInspector,
    RobotProfile,
)
from roboneuron.contract.arrays import F64
from roboneuron.contract.profile import prismatic_joints
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, UnsafeError
from roboneuron.gate.audit import AUDIT_FILE, AuditLog, AuditRecord
from roboneuron.gate.motion import (
    LimitedCommand,
    Motion,
    MotionLimiter,
    motion_rules,
)
from roboneuron.gate.motion.command import pick
from roboneuron.modules.status import StatusWriter

_RECORD_PERIOD_S = 1.0
"""A limit that keeps acting is recorded this often; every change is recorded at once, at most ten a
second.
"""
_CHANGE_PERIOD_S = 0.1
"""See above: a command at the edge of a limit may change what acts with each message."""
_SLACK, _SLACK_M = 0.05, 0.01
"""What noise and a late message may add to the way between two states [rad; m of slides]."""
_HASTE = 2.0
"""How many times its velocity limit a joint may seem to move: messages bunch up on a busy machine.
"""
log = logging.getLogger(__name__)


class JointWatch:
    """Keeps the newest joint state that can be true; used from the executor's thread.

    After `timeout_s` without one, the next state is compared with none before it: a clock that was
    set, or an arm that was moved while nobody listened, stops the arm for that long and not for
    ever.

    Attributes:
        joints: the newest state, or None when there was none.
    """

    def __init__(self, profile: RobotProfile, timeout_s: float) -> None:
        self.joints: JointSample | None = None
        self._position = np.empty(0)
        self._names = profile.arm_joints
        self._velocity = (
            None
            if profile.limits is None
            else np.asarray(profile.limits.velocity, dtype=np.float64)
        )
        slides = prismatic_joints(profile.urdf)
        self._slack = np.array(
            [_SLACK_M if name in slides else _SLACK for name in profile.arm_joints]
        )
        self._timeout_s = timeout_s
        self._at_s = 0.0

    def age_s(self, now_s: float) -> float:
        """Monotonic time since the newest state was accepted; infinite without one."""
        return np.inf if self.joints is None else now_s - self._at_s

    def accept(self, joints: JointSample, now_s: float, ros_now_ns: int) -> bool:
        """Take a state; False for one that repeats the one before.

        A state that is refused is not compared with: one wild value does not make those after it
        doubtful.

        Args:
            joints: as received.
            now_s: monotonic time.
            ros_now_ns: time by the clock of stamps.

        Raises:
            NotReadyError: it was measured too long ago.
            InvalidInputError: it is older than the one before, or its stamp lies in the future.
            UnsafeError: a joint of the arm is missing, not finite, or where it cannot have got to.
        """
        age_s = (ros_now_ns - joints.stamp_ns) / 1e9
        if abs(age_s) > self._timeout_s:
            late = age_s > 0
            # on a busy machine anything is late now and then
            error = NotReadyError if late else InvalidInputError
            raise error(
                f"A joint state was measured {abs(age_s):.3g} s "
                f"{'ago' if late else 'in the future'}, at most "
                f"{self._timeout_s:g} s are allowed.",
                hint="Is the robot's driver stuck, or are the clocks of two machines apart?",
            )
        if not np.isfinite(joints.position).all():
            raise UnsafeError("A joint state holds non-finite positions.")
        position = pick(joints.names, joints.position, self._names)
        if self.joints is not None and self.age_s(now_s) <= self._timeout_s:
            if joints.stamp_ns < self.joints.stamp_ns:
                raise InvalidInputError("A joint state is older than the one before.")
            if joints.stamp_ns == self.joints.stamp_ns:
                return False
            self._check_displacement(position, now_s)
        self.joints, self._position, self._at_s = joints, position, now_s
        return True

    def _check_displacement(self, position: F64, now_s: float) -> None:
        """Compare with the state before: |q - q'| <= _HASTE * v_max * dt + slack, for each joint.

        Raises:
            UnsafeError: names the joint that is farthest beyond.
        """
        if self._velocity is None:
            return
        before = self._position
        farthest = _HASTE * self._velocity * (now_s - self._at_s) + self._slack
        excess = np.abs(position - before) - farthest
        if excess.max() > 0.0:
            i = int(excess.argmax())
            raise UnsafeError(
                f"{self._names[i]} is measured at {position[i]:.4f}, "
                f"{abs(position[i] - before[i]):.4f} from where it "
                f"was {now_s - self._at_s:.3f} s before; no arm is that fast.",
                hint="Does something else publish joint states?",
            )


class MotionGuard:
    """Applies the limits of `[limits]` to one robot; used from the executor's thread.

    Attributes:
        follow, rest, reference, remaining_s: see `MotionLimiter`.
        close: closes the audit.

    Raises:
        ConfigurationError: the limits do not fit the robot.
    """

    def __init__(
        self,
        limits: LimitsConfig,
        profile: RobotProfile,
        controller: Controller,
        status: StatusWriter,
        state: Path,
        *,
        immediate: bool,
        longest_s: float,
    ) -> None:
        """Args:
        limits: in force.
        profile: of the robot, with the collision bodies that are in force.
        controller: tells poses, and distances where it can.
        status: tells what the limits do.
        state: directory of the audit.
        immediate: commands are joint states, which the robot follows at once.
        longest_s: a longer command is refused [s].
        """
        is_checked = profile.collision is None or isinstance(controller, PostureInspector)
        if not is_checked:
            log.warning(
                "The controller tells no distances: collisions of %s are not checked.", profile.name
            )
        status.set_value("collision_checked", is_checked and profile.collision is not None)
        self._limiter = MotionLimiter.of(
            motion_rules(limits, profile),
            profile,
            controller,
            immediate=immediate,
            longest_s=longest_s,
        )
        self._profile = profile
        self._status = status
        self._counts: Counter[str] = Counter()
        self._audit = AuditLog(state / AUDIT_FILE, time_ns)
        self.follow = self._limiter.follow
        self.rest = self._limiter.rest
        self.reference = self._limiter.reference
        self.remaining_s = self._limiter.remaining_s
        self.close = self._audit.close
        self._recorded: tuple[str, ...] = ()
        self._recorded_s = 0.0

    def use(self, limits: LimitsConfig) -> None:
        """Apply other limits from the next command on. Raises ConfigurationError as
        `motion_rules`.
        """
        self._limiter.use(motion_rules(limits, self._profile))

    def judge(
        self, command: JointCommand, joints: JointSample, now_s: float
    ) -> JointCommand | Hold | None:
        """What to send instead of `command`: itself, a shorter one, a reason to hold, or None for
        nothing.

        The status tells both: `asked_*` and `sent_*`, `limited.<name>` how often a limit acted,
        `limit` the last one.
        """
        verdict = self._limiter.limit(command, joints, now_s)
        self._report("asked", verdict.asked)
        self._report("sent", verdict.sent)
        self._status.set_value("sent_share", verdict.share)
        for name in verdict.acted:
            self._counts[name] += 1
            self._status.set_value(f"limited.{name}", self._counts[name])
        if verdict.reason:
            self._status.set_value("limit", verdict.reason)
        if verdict.reference_lost:
            self._counts["reference_lost"] += 1
            self._status.set_value("reference_lost", self._counts["reference_lost"])
        if verdict.command is None:
            self._status.dropped.add(f"limit_{verdict.acted[-1]}")
        self._record(verdict, now_s)
        return verdict.command

    def _report(self, word: str, motion: Motion | None) -> None:
        """Tell a motion in the status.

        Args:
            word: "asked" or "sent".
            motion: None where nothing was worked out.
        """
        if motion is None:
            return
        self._status.set_value(f"{word}_step_m", motion.step_m)
        self._status.set_value(f"{word}_step_rad", motion.step_rad)
        self._status.set_value(f"{word}_speed_m_s", motion.speed_m_s)
        self._status.set_value(f"{word}_joint_speed", motion.joint_speed)
        if motion.smallest_singular_value is not None:
            self._status.set_value(f"{word}_singular_value", motion.smallest_singular_value)

    def _record(self, verdict: LimitedCommand, now_s: float) -> None:
        """One line in the audit when the limits begin to act, act otherwise, or go on acting."""
        outcome = _outcome(verdict)
        state = (outcome, *verdict.acted) if verdict.reason else ()
        since_s = now_s - self._recorded_s
        if not state or since_s < (
            _CHANGE_PERIOD_S if state != self._recorded else _RECORD_PERIOD_S
        ):
            return
        self._recorded, self._recorded_s = state, now_s
        numbers: dict[str, Any] = {
            word: {
                name: round(value, 6)
                for name in Motion.__slots__
                if (value := getattr(motion, name)) is not None
            }
            for word, motion in (("asked", verdict.asked), ("sent", verdict.sent))
            if motion is not None
        }
        record = AuditRecord(
            who="control",
            role="",
            tool="action",
            verdict=outcome,
            robot=self._profile.name,
            endpoint="action",
            rule=", ".join(verdict.acted)
            or (verdict.command.code if isinstance(verdict.command, Hold) else ""),
            reason=verdict.reason,
            arguments={**numbers, "counts": dict(self._counts)},
        )
        try:
            self._audit.write(record)
        except RefusedError as error:
            self._status.dropped.add("unrecorded")
            log.error("%s", error)


def _outcome(verdict: LimitedCommand) -> str:
    if verdict.command is None:
        return "refused"
    return "held" if isinstance(verdict.command, Hold) else "scaled"
