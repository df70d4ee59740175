"""One lead: converts a teleoperator's samples to rows for control, within bounds, and only while
the person is present. Independent of ROS and threads; time is an argument.
"""

from __future__ import annotations

import math
import statistics
from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rn_standard.teleoperation.rows import LeadRow, Mode, RowKind
from rn_standard.teleoperation.samples import F64, LeadSample
from roboneuron import InvalidInputError, NotReadyError, RobotProfile, UnsafeError

LATE_S, LATEST_S, LATE_PERIODS = 0.045, 0.075, 2.2
"""Shortest and longest time without a sample after which the arm of a person is braked, and the
periods of the source that it is otherwise; the arm follows the next sample again. One lost sample
brakes nothing at 30 Hz.
"""
_PERIODS = 9
"""Intervals between samples whose median is the period of the source."""
SILENT_S = 0.1
"""Time without a sample after which the switch has to be pressed again."""
GONE_S = 1.0
"""Time without a sample after which the lead is over."""
_BRAKE_S = 0.3
"""Time in which an arm is braked within its limits before control holds it."""
_AHEAD_S = 0.05
"""Tolerance for rounding of a machine's clocks: a sample cannot be measured later than now."""
_MOST_M_S, _MOST_RAD_S = 5.0, 30.0
"""Bounds of plausible commands; larger ones are faulty."""
_FARTHEST_RAD = 0.3
"""Largest distance of a leader from the arm [rad or m]; it has to approach first."""
_REMEMBERED = 200
_AGAIN = "Start leading again."


@dataclass(frozen=True, kw_only=True, slots=True)
class LeadSpeeds:
    """Largest speeds of a lead.

    Attributes:
        linear_m_s, angular_rad_s: of the TCP.
        joint_share: fraction of the joints' velocity limits.
    """

    linear_m_s: float = 0.25
    angular_rad_s: float = 0.8
    joint_share: float = 0.25

    def scaled(self, scale: float) -> LeadSpeeds:
        """These speeds times `scale`, 0 .. 1."""
        return LeadSpeeds(
            linear_m_s=self.linear_m_s * scale,
            angular_rad_s=self.angular_rad_s * scale,
            joint_share=self.joint_share * scale,
        )


class LeadSession:
    """Commands of one person, from the start to the hand-back. Used from one thread.

    Attributes:
        why_still: reason why the arm does not follow, with a remedy; empty while it may.
        scale: factor of the speeds, 0 .. 1.
        rate_hz: rows per second.
    """

    def __init__(
        self,
        name: str,
        mode: Mode,
        profile: RobotProfile,
        speeds: LeadSpeeds,
        now_s: float,
        *,
        rate_hz: float = 50.0,
        scale: float = 1.0,
    ) -> None:
        """Args:
        name: unique name of the lead.
        mode: "person" or "blend".
        profile: profile of the robot.
        speeds: the largest speeds.
        now_s: monotonic time.
        rate_hz: rows per second.
        scale: factor of the speeds.
        """
        self.name, self.mode = name, mode
        self._profile, self._speeds, self.rate_hz = profile, speeds, rate_hz
        self.scale = scale
        limits = profile.limits
        self._velocities = (
            {}
            if limits is None
            else dict(zip(profile.arm_joints, np.asarray(limits.velocity).tolist(), strict=True))
        )
        self._sample: LeadSample | None = None
        self._heard_s = self._moved_s = now_s
        self._intervals: deque[float] = deque(maxlen=_PERIODS)
        self._must_release = True
        self._number = 0
        self._sent: OrderedDict[int, tuple[int, float]] = OrderedDict()
        self._goals: dict[str, float] = {}
        self.why_still = ""

    def take(self, sample: LeadSample, now_s: float) -> None:
        """Process a sample.

        Raises:
            UnsafeError: a value is not finite, or not plausible.
            InvalidInputError: it names a joint that the arm does not have, or its clock is wrong.
        """
        before = self._sample
        if before is not None and sample.number <= before.number:
            return
        self._check_clock(sample, before, now_s)
        self._check_values(sample)
        if now_s - sample.at_s > SILENT_S:  # delayed on its way
            return
        if now_s - self._heard_s > SILENT_S:
            self._must_release = True
        if not sample.is_held:
            self._must_release = False
        self._sample = sample
        # a device that repeats what it has measured before is silent
        if before is None or sample.at_s > before.at_s:
            if before is not None:
                self._intervals.append(sample.at_s - before.at_s)
            self._heard_s = now_s

    def row(self, now_s: float, measured: Mapping[str, float]) -> LeadRow:
        """Return the row for this period.

        Args:
            now_s: monotonic time.
            measured: joints by name [rad, m].

        Raises:
            NotReadyError: no sample has arrived for `GONE_S`, or a leader is not close to the arm.
        """
        silent_s = now_s - self._heard_s
        if silent_s > GONE_S:
            raise NotReadyError(
                f"Whoever leads has been silent for {silent_s:.1f} s; the arm rests.", hint=_AGAIN
            )
        if silent_s > SILENT_S:
            self._must_release = True
        sample = self._sample
        self.why_still = self._why_still(sample, silent_s)
        if self.why_still or sample is None:
            self._goals = {}
            kind: RowKind = "still" if now_s - self._moved_s < _BRAKE_S else "rest"
            return self._made(kind, (), np.zeros(0), None)
        self._moved_s = now_s
        opening = sample.gripper_open
        if sample.twist is not None:
            return self._made("twist", (sample.frame,), self._bounded(sample.twist), opening)
        if sample.positions:
            goals = self._approach(sample.positions, measured)
            values = np.array(list(goals.values()))
            return self._made("joint_position", tuple(goals), values, opening)
        if sample.velocities:
            names = tuple(sample.velocities)
            values = np.array([self._joint_speed(name, sample.velocities[name]) for name in names])
            return self._made("joint_velocity", names, values, opening)
        # the gripper alone
        return self._made("twist", ("base",), np.zeros(6), opening)

    def still_row(self) -> LeadRow:
        """Create a row that brakes the arm."""
        return self._made("still", (), np.zeros(0), None)

    def end_row(self, mode: Mode) -> LeadRow:
        """Create the last row: "back" or "lost"."""
        self._number += 1
        return LeadRow(session=self.name, number=self._number, mode=mode, values=np.zeros(0))

    def sample_of(self, number: int) -> tuple[int, float] | None:
        """Number and time [monotonic s] of the sample behind a row; None for an old row."""
        return self._sent.get(number)

    def _why_still(self, sample: LeadSample | None, silent_s: float) -> str:
        if sample is None:
            return "nothing has come yet"
        if silent_s > SILENT_S:
            return "silent: release the switch and press it again"
        if not sample.is_held:
            return "the switch is released"
        if self._must_release:
            return "release the switch and press it again"
        is_late = self.mode == "person" and silent_s > self._late_s()
        return "late: the source is slow" if is_late else ""

    def _late_s(self) -> float:
        """Time without a sample after which the arm is braked, by the period of the source [s]."""
        if not self._intervals:
            return LATEST_S
        period_s = statistics.median(self._intervals)
        return min(max(LATE_S, LATE_PERIODS * period_s), LATEST_S)

    def _made(
        self,
        kind: RowKind,
        keys: tuple[str, ...],
        values: F64,
        gripper_open: float | None,
    ) -> LeadRow:
        self._number += 1
        if self._sample is not None:
            self._sent[self._number] = self._sample.number, self._sample.at_s
            while len(self._sent) > _REMEMBERED:
                self._sent.popitem(last=False)
        return LeadRow(
            session=self.name,
            number=self._number,
            mode=self.mode,
            kind=kind,
            keys=keys,
            values=values,
            gripper_open=gripper_open,
            rate_hz=self.rate_hz,
        )

    def _check_clock(self, sample: LeadSample, before: LeadSample | None, now_s: float) -> None:
        is_ahead = not sample.at_s <= now_s + _AHEAD_S  # true for NaN
        if is_ahead or (before is not None and sample.at_s < before.at_s):
            raise InvalidInputError(
                f"The clock of the source is wrong: a sample of {sample.at_s:.3f} s came at "
                f"{now_s:.3f} s.",
                hint=f"Set that clock, or load the page again. {_AGAIN}",
            )

    def _check_values(self, sample: LeadSample) -> None:
        numbers = [*sample.velocities.values(), *sample.positions.values()]
        if sample.twist is not None:
            if sample.twist.shape != (6,):
                raise InvalidInputError(f"A twist has the shape {sample.twist.shape}, not (6,).")
            numbers += sample.twist.tolist()
        if sample.gripper_open is not None:
            numbers.append(sample.gripper_open)
        if not all(map(math.isfinite, numbers)):
            raise UnsafeError(
                "The source has sent a number that is not finite; the arm rests.",
                hint=f"See whether the device works. {_AGAIN}",
            )
        if sample.gripper_open is not None and not 0.0 <= sample.gripper_open <= 1.0:
            raise UnsafeError(
                f"The source asks for a gripper's opening of {sample.gripper_open:g}; expected "
                "0 .. 1.",
                hint=_AGAIN,
            )
        self._check_speeds(sample)
        names = {*sample.velocities, *sample.positions}
        unknown = sorted(names - set(self._profile.arm_joints))
        absent = sorted(set(self._profile.arm_joints) - names) if sample.positions else []
        if unknown or absent:
            raise InvalidInputError(
                f"The source names {', '.join(unknown) or 'not'} {', '.join(absent)}; the arm has "
                f"the joints {', '.join(self._profile.arm_joints)}.",
                hint="Give the leader's joints the names of the arm's.",
            )

    def _check_speeds(self, sample: LeadSample) -> None:
        twist = np.zeros(6) if sample.twist is None else sample.twist
        linear = float(np.linalg.norm(twist[:3]))
        turns = [float(np.linalg.norm(twist[3:])), *map(abs, sample.velocities.values())]
        if linear > _MOST_M_S or max(turns) > _MOST_RAD_S:
            raise UnsafeError(
                f"The source asks for {linear:.3g} m/s and {max(turns):.3g} rad/s, which no person "
                "means; the arm rests.",
                hint=f"See whether the device works, and its scale. {_AGAIN}",
            )

    def _bounded(self, twist: F64) -> F64:
        """Scale a twist to the speeds of this lead, keeping its direction."""
        speeds = self._speeds.scaled(self.scale)
        bounded = twist.astype(np.float64) * self.scale
        for part, most in ((slice(0, 3), speeds.linear_m_s), (slice(3, 6), speeds.angular_rad_s)):
            length = float(np.linalg.norm(bounded[part]))
            if length > most:
                bounded[part] *= most / length
        return bounded

    def _joint_speed(self, name: str, asked: float) -> float:
        most: float = self._speeds.joint_share * self.scale * self._velocities[name]
        return min(max(asked * self.scale, -most), most)

    def _approach(
        self, wanted: Mapping[str, float], measured: Mapping[str, float]
    ) -> dict[str, float]:
        """Goals that approach the leader's positions.

        Raises:
            NotReadyError: the arm is not measured, or the leader is too far from it.
        """
        missing = [name for name in wanted if name not in measured]
        if missing:
            raise NotReadyError(f"{', '.join(missing)} are not measured.", hint="Start the robot.")
        if not self._goals:
            far = {name: abs(wanted[name] - measured[name]) for name in wanted}
            worst = max(far, key=far.__getitem__)
            if far[worst] > _FARTHEST_RAD:
                raise NotReadyError(
                    f"The leader's {worst} is {far[worst]:.2f} rad from the arm's; at most "
                    f"{_FARTHEST_RAD} are allowed.",
                    hint=f"Bring the leader nearer. {_AGAIN}",
                )
            self._goals = {name: measured[name] for name in wanted}
        for name, goal in self._goals.items():
            step = self._speeds.joint_share * self.scale * self._velocities[name] / self.rate_hz
            self._goals[name] = goal + min(max(wanted[name] - goal, -step), step)
        return dict(self._goals)
