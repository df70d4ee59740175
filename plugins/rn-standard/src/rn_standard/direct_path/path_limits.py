"""Limits of place and speed on joint motions: forward kinematics along the path, by control's
rules.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from roboneuron import F64, JointSample, Obstacle, Posture, RefusedError, RobotProfile, UnsafeError
from roboneuron.feature import MotionRules, Reach, task_space

MAX_POSTURES = 20_000
"""Longest path [postures]; checking a longer one would take seconds."""
_SLACK = 1e-6
"""Relative tolerance on a speed for rounding."""


class LimitError(RefusedError):
    """A motion violates a limit; `limit` is its name, from `LIMITS`."""

    def __init__(self, limit: str, message: str, hint: str = "") -> None:
        super().__init__(message, hint=hint, rule=limit)
        self.limit = limit


def check_zones(lower_m: F64, upper_m: F64, zones: Sequence[Obstacle], where: str) -> None:
    """Raise LimitError if a box intersects a zone."""
    for zone in zones:
        if (lower_m <= zone.upper_m).all() and (upper_m >= zone.lower_m).all():
            raise LimitError("zone", f"{where}The TCP may come into the zone {zone.name!r}.")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Leg:
    """A segment of a joint path: some joints move to `position`, the others stay.

    Attributes:
        names: the commanded joints.
        position: their targets, float64 (n,) [rad or m].
        duration_s: its duration; None if unknown, then its speed is not checked.
        velocity: float64 (n,), at the end of the leg, if the command contains one: drivers may then
            interpolate with a cubic.
        where: position in the command, for messages.
    """

    names: tuple[str, ...]
    position: F64
    duration_s: float | None
    velocity: F64 | None = None
    where: str = ""


class PathLimiter:
    """Checks paths in joint space for one robot, the TCP of each of its arms; thread-safe.

    `Reach` determines the sampling density, and the TCP's path between two samples is tested as a
    line, so that neither a zone nor a link is missed. Singularities are not limited here: joint
    motions do not depend on the Jacobian's inverse.

    Args:
        rules: the limits of `[limits]`; a violation is refused, whatever the reaction for actions.
        profile: profile of the robot, with the `collision` in force.
        inspect: computes a posture's TCP and distances; raises UnsafeError.
    """

    def __init__(
        self, rules: MotionRules, profile: RobotProfile, inspect: Callable[[JointSample], Posture]
    ) -> None:
        self._task = task_space.TaskSpace(rules)
        self._needs_distances = profile.collision is not None
        self._inspect = inspect
        self._reach = Reach(profile)
        self._lock = threading.Lock()

    def check(self, legs: Iterable[Leg], joints: JointSample) -> None:
        """Raise LimitError for the first limit that the path violates.

        Args:
            legs: in their order.
            joints: measured state of every joint of the arm.
        """
        ratio, reason = 1.0, ""
        with self._judging():
            for leg, before, there, duration_s in self._walk(legs, joints):
                for start, end in zip(before.arms, there.arms, strict=True):
                    for name, told in self._task.places(start.pose, end, partial(_given, start)):
                        if name != "singularity":
                            raise LimitError(
                                name, f"{leg.where}{told}", hint="Choose another path or target."
                            )
                for times, told in self._speeds(before, there, duration_s):
                    if times > ratio:
                        ratio, reason = times, f"{leg.where}{told}"
        if ratio > 1.0 + _SLACK:
            times = math.ceil((ratio - _SLACK) * 100.0) / 100.0
            raise LimitError("speed", reason, hint=f"Give it {times:g} times the time.")

    def check_stand(self, leg: Leg, joints: JointSample) -> Posture:
        """Return the posture at the end of a leg; raises LimitError if it is forbidden, whatever
        path leads to it.

        Args:
            leg: the moved joints.
            joints: measured state of every joint of the arm.
        """
        names, here = _finite(joints)
        with self._judging():
            target, _ = _target(leg, names, here)
            there = self._evaluate(names, target)
        for arm in there.arms:
            for name, told in self._task.places(arm.pose, arm, partial(_given, arm)):
                if name != "singularity":
                    raise LimitError(name, f"{leg.where}{told}", hint="Choose another target.")
        return there

    def posture(self, joints: JointSample) -> Posture:
        """Evaluate a posture. Raises LimitError if that fails."""
        with self._judging():
            return self._evaluate(*_finite(joints))

    def slowdown(self, legs: Iterable[Leg], joints: JointSample) -> float:
        """Factor, at least 1, on the legs' durations that the TCP needs to respect its speed
        limits.
        """
        with self._judging():
            steps = self._walk(legs, joints)
            return max(
                [
                    1.0,
                    *(
                        times
                        for _, a, b, duration_s in steps
                        for times, _ in self._speeds(a, b, duration_s)
                    ),
                ]
            )

    @contextmanager
    def _judging(self) -> Iterator[None]:
        """Lock for one path at a time; raises LimitError for a posture that cannot be evaluated."""
        with self._lock:
            try:
                yield
            except UnsafeError as error:
                raise LimitError(
                    "kinematics", f"The motion cannot be checked: {error.message}"
                ) from error

    def _speeds(
        self, before: Posture, there: Posture, duration_s: float
    ) -> Iterator[tuple[float, str]]:
        """Ratios of the TCP's speeds between two postures to their limits, with a text for each."""
        if not duration_s:
            return
        for start, end in zip(before.arms, there.arms, strict=True):
            motion = self._task.motion(start.pose, start.pose, end, duration_s, 0.0)
            yield from (
                (times, reason)
                for name, times, reason in self._task.excess(motion)
                if name == "speed"
            )

    def _walk(
        self, legs: Iterable[Leg], joints: JointSample
    ) -> Iterator[tuple[Leg, Posture, Posture, float]]:
        """Yield consecutive postures on the legs, and the time between them [s], 0 if unknown."""
        names, here = _finite(joints)
        velocity, left, start = np.zeros_like(here), MAX_POSTURES, self._evaluate(names, here)
        for leg in legs:
            target, end_velocity = _target(leg, names, here)
            change, duration_s = target - here, leg.duration_s or 0.0
            bends: list[tuple[F64, F64] | None] = [None]
            if leg.velocity is not None and duration_s:  # a driver may follow the line or the cubic
                bends.append((velocity * duration_s, end_velocity * duration_s))
            for bend in bends:
                farthest = (
                    np.abs(change)
                    if bend is None
                    else np.abs([change, *np.multiply(bend, 1.5)]).max(axis=0)
                )
                count = self._reach.count(names, farthest)
                left -= count
                if left < 0:
                    raise LimitError(
                        "length",
                        "The path is too long to be checked.",
                        hint="Send it in several calls.",
                    )
                before = start
                for position in here + _shape(change, bend, count):
                    there = self._evaluate(names, position)
                    yield leg, before, there, duration_s / count
                    before = there
            here, velocity, start = target, end_velocity, before

    def _evaluate(self, names: tuple[str, ...], position: F64) -> Posture:
        posture = self._inspect(JointSample(names=names, position=position))
        if self._needs_distances and posture.near is None:
            raise UnsafeError(
                "the controller reports no distances between links; see limits.collision"
            )
        return posture


def _finite(joints: JointSample) -> tuple[tuple[str, ...], F64]:
    """The measured joints."""
    finite = np.isfinite(joints.position)
    names = tuple(name for name, good in zip(joints.names, finite.tolist(), strict=True) if good)
    return names, np.asarray(joints.position, dtype=np.float64)[finite]


def _target(leg: Leg, names: tuple[str, ...], here: F64) -> tuple[F64, F64]:
    """Position and velocity of all joints at the end of a leg."""
    target, velocity = here.copy(), np.zeros_like(here)
    for index, name in enumerate(leg.names):
        if name not in names:
            raise UnsafeError(f"Joint {name!r} is not measured.")
        target[names.index(name)] = leg.position[index]
        if leg.velocity is not None:
            velocity[names.index(name)] = leg.velocity[index]
    return target, velocity


def _shape(change: F64, bend: tuple[F64, F64] | None, count: int) -> F64:
    """Postures after the start, relative to it, float64 (count, n): on a line, or on the cubic with
    these end slopes.
    """
    s = np.arange(1, count + 1)[:, np.newaxis] / count
    if bend is None:
        line: F64 = s * change
        return line
    cubic: F64 = (
        s * s * (3.0 - 2.0 * s) * change
        + s * (1.0 - s) ** 2 * bend[0]
        - s * s * (1.0 - s) * bend[1]
    )
    return cubic


def _given(posture: Posture) -> Posture:
    return posture
