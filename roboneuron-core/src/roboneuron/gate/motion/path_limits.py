"""Limits of place and speed on joint motions: forward kinematics along the path, by control's
rules.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from roboneuron.contract import JointSample, Obstacle, Pose, Posture, RobotProfile
from roboneuron.contract.arrays import F64
from roboneuron.errors import RefusedError, UnsafeError
from roboneuron.gate.motion import task_space
from roboneuron.gate.motion.path import Reach, postures
from roboneuron.gate.motion.rules import MotionRules

__all__ = ["Leg"]
"""Names that other distributions may use."""

MAX_POSTURES = 20_000
"""Longest path [postures]; checking a longer one would take seconds."""
_SLACK = 1e-6
"""Relative tolerance on a speed for rounding."""
_LEAST = 1e-3
"""Motion of a joint that is worth a call [rad or m]."""
_BACK = 0.98
"""Share of the path to the last allowed posture that a hint gives: its numbers are rounded."""


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


class _Passed(NamedTuple):
    """A posture on the way: the TCPs, and a function that returns the whole of an arm's."""

    poses: tuple[Pose, ...]
    arm: Callable[[int], Posture]


class _Step(NamedTuple):
    """Part of a path between two postures that are evaluated.

    Attributes:
        leg: the leg that it is part of.
        number: of the leg, from 0.
        begin: positions of all joints at the beginning of the leg, float64 (n,) [rad or m].
        position: those at the beginning of the step.
        names: of these joints.
        before, there: the postures.
        duration_s: time between them, 0 if unknown.
    """

    leg: Leg
    number: int
    begin: F64
    position: F64
    names: tuple[str, ...]
    before: _Passed
    there: Posture
    duration_s: float


class _Forbidden(NamedTuple):
    """A place of a path that a limit forbids."""

    step: _Step
    violation: task_space.PlaceViolation

    @property
    def told(self) -> str:
        """Where it is, and why."""
        return f"{self.step.leg.where}{self.violation.reason}"


def _passed(posture: Posture) -> _Passed:
    arms = posture.arms
    return _Passed(tuple(arm.pose for arm in arms), arms.__getitem__)


class PathLimiter:
    """Checks paths in joint space for one robot, the TCP of each of its arms; thread-safe.

    `Reach` determines the sampling density, and the TCP's path between two samples is tested as a
    line, so that neither a zone nor a link is missed. Singularities are not limited here: joint
    motions do not depend on the Jacobian's inverse.

    Args:
        rules: the limits of `[limits]`; a violation is refused, whatever the reaction for actions.
        profile: profile of the robot, with the `collision` in force.
        inspect: computes a posture's TCP and distances; raises UnsafeError.
        poses: computes the TCP of each arm alone; saves time at the start of a path.
    """

    def __init__(
        self,
        rules: MotionRules,
        profile: RobotProfile,
        inspect: Callable[[JointSample], Posture],
        poses: Callable[[JointSample], tuple[Pose, ...]] | None = None,
    ) -> None:
        self._needs_distances = profile.collision is not None
        self._inspect, self._poses = inspect, poses
        self._reach = Reach(profile)
        self._arms = [f"{arm.name}: " if arm.name else "" for arm in profile.each_arm]
        # for one posture: a short path need not wait for the end of a long one
        self._lock = threading.RLock()
        self.use(rules)

    def use(self, rules: MotionRules) -> None:
        """Apply other rules from the next posture on."""
        self._task = task_space.TaskSpace(rules)

    def check(self, legs: Iterable[Leg], joints: JointSample) -> None:
        """Raise LimitError for the first limit that the path violates; of places it also tells the
        deepest one, and how far the path is allowed.

        Args:
            legs: in their order.
            joints: measured state of every joint of the arm.
        """
        ratio, reason = 1.0, ""
        first: _Forbidden | None = None
        deepest: _Forbidden | None = None
        try:
            with _judging():
                for step in self._walk(legs, joints):
                    for violation in self._violations(step):
                        found = _Forbidden(step, violation)
                        first = first or found
                        if deepest is None or violation.depth > deepest.violation.depth:
                            deepest = found
                    for times, told in () if first else self._speeds(step):
                        if times > ratio:
                            ratio, reason = times, f"{step.leg.where}{told}"
        except LimitError:
            if first is None:
                raise
        if first is not None and deepest is not None:
            raise _refusal(first, deepest)
        if reason:
            times = math.ceil((ratio - _SLACK) * 100.0) / 100.0
            raise LimitError("speed", reason, hint=f"Give it {times:g} times the time.")

    def speeds(self, legs: Iterable[Leg], joints: JointSample) -> Iterator[tuple[Leg, float, str]]:
        """Yield the ratios of the TCP's speeds along the path to their limits, those above 1, with
        a text for each; raises LimitError for the first place that is forbidden, at once.
        """
        with _judging():
            for step in self._walk(legs, joints):
                for violation in self._violations(step):
                    raise _refusal(_Forbidden(step, violation), _Forbidden(step, violation))
                for times, told in self._speeds(step):
                    yield step.leg, times, told

    def count(self, leg: Leg, before: Mapping[str, float]) -> int:
        """Number of postures on a leg from these positions, by joint."""
        change = [
            abs(end - before.get(name, end))
            for name, end in zip(leg.names, leg.position.tolist(), strict=True)
        ]
        return self._reach.count(leg.names, np.array(change))

    def check_stand(self, leg: Leg, joints: JointSample) -> Posture:
        """Return the posture at the end of a leg; raises LimitError if it is forbidden, whatever
        path leads to it.

        Args:
            leg: the moved joints.
            joints: measured state of every joint of the arm.
        """
        names, here = _finite(joints)
        with _judging():
            target, _ = _target(leg, names, here)
            there = self._evaluate(names, target)
        for number, arm in enumerate(there.arms):
            for violation in self._places(number, arm.pose, arm, partial(_given, arm)):
                reason = f"{leg.where}{violation.reason}"
                raise LimitError(violation.limit, reason, hint="Choose another target.")
        return there

    def posture(self, joints: JointSample) -> Posture:
        """Evaluate a posture. Raises LimitError if that fails."""
        with _judging():
            return self._evaluate(*_finite(joints))

    def slowdown(self, legs: Iterable[Leg], joints: JointSample) -> float:
        """Factor, at least 1, on the legs' durations that the TCP needs to respect its speed
        limits.
        """
        with _judging():
            ratios = [times for step in self._walk(legs, joints) for times, _ in self._speeds(step)]
        return max([1.0, *ratios])

    def _violations(self, step: _Step) -> Iterator[task_space.PlaceViolation]:
        """Limits of place that a step violates."""
        for number, (start, end) in enumerate(zip(step.before.poses, step.there.arms, strict=True)):
            yield from self._places(number, start, end, partial(step.before.arm, number))

    def _places(
        self, number: int, start: Pose, end: Posture, evaluate_start: Callable[[], Posture]
    ) -> list[task_space.PlaceViolation]:
        """Limits that the end of a step, or the line to it, violates, for one arm."""
        with self._lock:  # a posture may compute where its links are when it is asked
            return [
                one._replace(reason=f"{self._arms[number]}{one.reason}")
                for one in self._task.places(start, end, evaluate_start)
                if one.limit != "singularity"
            ]

    def _speeds(self, step: _Step) -> Iterator[tuple[float, str]]:
        """Ratios above 1 of the TCP's speeds between two postures to their limits, with a text for
        each.
        """
        if not step.duration_s:
            return
        for start, end in zip(step.before.poses, step.there.arms, strict=True):
            motion = self._task.motion(start, start, end, step.duration_s, 0.0)
            for name, times, reason in self._task.excess(motion):
                if name == "speed" and times > 1.0 + _SLACK:
                    yield times, reason

    def _walk(self, legs: Iterable[Leg], joints: JointSample) -> Iterator[_Step]:
        """Yield the steps of the legs, between consecutive postures."""
        names, here = _finite(joints)
        velocity, left, start = np.zeros_like(here), MAX_POSTURES, self._start(names, here)
        for index, leg in enumerate(legs):
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
                before, passed = start, here
                for position in postures(here, change, count, bend):
                    there, time_s = self._evaluate(names, position), duration_s / count
                    yield _Step(leg, index, here, passed, names, before, there, time_s)
                    before, passed = _passed(there), position
            here, velocity, start = target, end_velocity, before

    def _start(self, names: tuple[str, ...], position: F64) -> _Passed:
        """The posture at the start of a path, of which mostly the TCPs alone are needed."""
        if self._poses is None:
            return _passed(self._evaluate(names, position))
        with self._lock:
            poses = self._poses(JointSample(names=names, position=position))
        return _Passed(poses, lambda number: self._evaluate(names, position).arms[number])

    def _evaluate(self, names: tuple[str, ...], position: F64) -> Posture:
        with self._lock:
            posture = self._inspect(JointSample(names=names, position=position))
        if self._needs_distances and posture.near is None:
            raise UnsafeError(
                "the controller reports no distances between links; see limits.collision"
            )
        return posture


def _refusal(first: _Forbidden, deepest: _Forbidden) -> LimitError:
    """The error for a path: where it is first forbidden, where it is deepest, and the part that is
    allowed.
    """
    message, depth_mm = first.told, task_space.whole_mm(deepest.violation.depth)
    if deepest.step is not first.step:
        message = f"{message} Deepest, by {depth_mm} mm: {deepest.told}"
    return LimitError(
        first.violation.limit,
        message,
        hint=f"Choose another path or target. {_allowed_part(first.step)}",
    )


def _allowed_part(step: _Step) -> str:
    """What of a path comes before its first forbidden step, as a call if it is on its first leg."""
    leg = step.leg
    if step.number:
        return f"What comes before {leg.where.removesuffix(': ') or 'this part'} is allowed."
    begin = dict(zip(step.names, step.begin.tolist(), strict=True))
    last = dict(zip(step.names, step.position.tolist(), strict=True))
    positions = {
        name: round(begin[name] + _BACK * (last[name] - begin[name]), 4) for name in leg.names
    }
    if all(abs(positions[name] - begin[name]) < _LEAST for name in leg.names):
        return "Not even its beginning is allowed."
    return f"Allowed that way: move_joints {json.dumps({'positions': positions})}"


@contextmanager
def _judging() -> Iterator[None]:
    """Raise LimitError for a posture that cannot be evaluated."""
    try:
        yield
    except UnsafeError as error:
        raise LimitError("kinematics", f"The motion cannot be checked: {error.message}") from error


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


def _given(posture: Posture) -> Posture:
    return posture
