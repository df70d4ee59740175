"""Joint commands of control: check of their joints, last setpoint, step to be limited, result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from roboneuron.contract import F64, Hold, JointCommand, JointSample
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.gate.motion.task_space import Motion

FARTHEST = 1e4
"""Largest plausible joint position [rad or m]; larger numbers are corrupt."""
_TOGETHER_S = 1e-3


def pick(names: tuple[str, ...], position: F64, wanted: tuple[str, ...]) -> F64:
    """Positions of the `wanted` joints, float64 (n,). Raises UnsafeError unless each occurs once
    and is finite.
    """
    values = np.asarray(position, dtype=np.float64)
    if values.shape != (len(names),) or len(set(names)) != len(names):
        raise UnsafeError(
            f"{len(names)} joints are named, {len(set(names))} different, with positions of shape "
            f"{values.shape}."
        )
    if names != wanted:
        missing = [name for name in wanted if name not in names]
        if missing:
            raise UnsafeError(f"The joints {list(names)} lack {missing} of the arm.")
        values = values[[names.index(name) for name in wanted]]
    if not (np.abs(values) <= FARTHEST).all():  # false for NaN
        raise UnsafeError(f"A joint of the arm is at no possible position: {values.tolist()}.")
    return values


def pick_others(
    command: JointCommand,
    joints: JointSample,
    arm: tuple[str, ...],
    limits: Mapping[str, JointLimit],
) -> tuple[tuple[str, ...], F64]:
    """Names and positions of the finite joints other than the arm's: as commanded, or else as
    measured.

    Raises:
        UnsafeError: a commanded one is unknown or leaves its travel.
    """
    if joints.names == arm and len(command.names) == len(arm):
        return (), np.zeros(0)
    known = dict(zip(joints.names, joints.position.tolist(), strict=False))
    for name, value in zip(command.names, command.position.tolist(), strict=False):
        if name in arm:
            continue
        if name not in limits:
            raise UnsafeError(
                f"A command names the joint {name!r}, which is neither the arm's nor the gripper's."
            )
        if not limits[name].allows("position", value):
            travel = f"{limits[name].lower:g} .. {limits[name].upper:g}"
            raise UnsafeError(f"The gripper would go to {value:g}, its travel is {travel}.")
        known[name] = value
    kept = {
        name: value for name, value in known.items() if name not in arm and abs(value) <= FARTHEST
    }
    return tuple(kept), np.array(list(kept.values()))


Answer = Callable[[JointSample, float, float], JointCommand | Hold]
"""Computes the target of one row from the newest measured joints, the available time [s], and the
monotonic time of execution [s].
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Asked:
    """Content of one action.

    Attributes:
        now: the row that is due.
        later: planned rows with absolute targets, evaluated at the end of the previous row; sent
            with it as far as `[control] horizon_s` reaches. They are not reported as limited: each
            is evaluated again when it is due.
        step_s: time between two rows [s].
    """

    now: Answer
    later: tuple[Answer, ...] = ()
    step_s: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Setpoint:
    """The last command sent: a straight line in joint space at constant velocity.

    Attributes:
        start, displacement: float64 (n,) [rad or m].
        duration_s: time for `displacement`.
        sent_s: monotonic time.
        immediate: the command carries no time, so that the robot may jump to its end (JointState
            commands).
        goal: float64 (n,), its end before limits were applied.
        goal_velocity: float64 (n,), of successive goals.
    """

    start: F64
    displacement: F64
    duration_s: float
    sent_s: float
    immediate: bool
    goal: F64
    goal_velocity: F64

    @classmethod
    def at_rest(cls, position: F64, now_s: float) -> Self:
        """An arm that rests at `position`, float64 (n,)."""
        still = np.zeros_like(position)
        return cls(
            start=position,
            displacement=still,
            duration_s=1.0,
            sent_s=now_s,
            immediate=False,
            goal=position,
            goal_velocity=still,
        )

    def at(self, now_s: float, braking: F64) -> tuple[F64, F64]:
        """Position and velocity at a monotonic time.

        Args:
            now_s: a time before `sent_s` counts as `sent_s`.
            braking: float64 (n,), the joints' acceleration limits, with which the velocity ends
                after the end of the command: no arm stops at once.

        Returns:
            Both float64 (n,).
        """
        passed = (now_s - self.sent_s) / self.duration_s
        # The time before an immediate command determined its length; the arm has that velocity
        # until the next one is due.
        ends = 2.0 if self.immediate else 1.0
        velocity = self.displacement / self.duration_s
        share = 1.0 if self.immediate else min(1.0, max(0.0, passed))
        position = self.start + self.displacement * share
        if passed > ends:
            left = np.maximum(np.abs(velocity) - braking * ((passed - ends) * self.duration_s), 0.0)
            velocity = np.copysign(left, velocity)
        return position, velocity

    def goal_velocity_to(self, goal: F64, duration_s: float, now_s: float) -> F64:
        """Velocity of successive goals, for one that arrives now and has to be reached in
        `duration_s`, float64 (n,) [rad or m per s].
        """
        since_s = now_s - self.sent_s
        # the first goal, or messages that arrive together: the interval is meaningless
        return (goal - self.goal) / (since_s if since_s > _TOGETHER_S else duration_s)

    def steady_velocity_to(self, goal: F64, duration_s: float, now_s: float) -> F64:
        """Velocity with which the goals continue: a joint must be slow at a goal that stays, but
        not at one that moves on. Arguments as of `goal_velocity_to`.

        A jump does not count as motion: the smaller of the last two velocities is used, or zero if
        their signs differ.
        """
        newest, before = self.goal_velocity_to(goal, duration_s, now_s), self.goal_velocity
        smaller = np.copysign(np.minimum(np.abs(newest), np.abs(before)), newest)
        return np.where(newest * before > 0.0, smaller, 0.0)


@dataclass(kw_only=True, slots=True, eq=False)
class Step:
    """One command during limiting; arrays are float64 (n,) in the order of the profile's arm
    joints.

    Attributes:
        measured: joint positions.
        last: the setpoint that it replaces.
        start, before: setpoint and commanded velocity at the start of the command.
        target: commanded positions; scaled in place.
        goal: commanded positions; never modified.
        goal_velocity: of successive goals.
        passed_s: time since the last command, at most `duration_s`: the time available for
            acceleration.
        others: names and positions of joints beside the arm's, as commanded, otherwise as measured.
        is_lost: the measured joints do not follow the setpoint.
        acted, reason: the limits that scaled the command, and a sentence on the last one.
    """

    measured: F64
    last: Setpoint
    start: F64
    before: F64
    target: F64
    goal: F64
    goal_velocity: F64
    duration_s: float
    passed_s: float
    stamp_ns: int
    others: tuple[tuple[str, ...], F64]
    is_lost: bool
    asked: Motion | None = None
    acted: list[str] = field(default_factory=list)
    reason: str = ""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LimitedCommand:
    """Result of the limiter for one command of control.

    Attributes:
        command: what to send, a hold, or None: the command is rejected and the previous one
            continues.
        acted: limits, from `LIMITS`, that scaled or rejected the command; empty when it is
            unchanged.
        reason: one sentence for the last of them, with the numbers; empty when the command is
            unchanged.
        share: ratio of the sent to the commanded step's length in joint space; 1 if unchanged.
        asked: properties of the command; None for an invalid one (non-finite, unknown joints).
        sent: properties of the sent command; None if nothing is sent or the arm holds.
        reference_lost: the measured joints did not follow the setpoint.
    """

    command: JointCommand | Hold | None
    acted: tuple[str, ...] = ()
    reason: str = ""
    share: float = 1.0
    asked: Motion | None = None
    sent: Motion | None = None
    reference_lost: bool = False
