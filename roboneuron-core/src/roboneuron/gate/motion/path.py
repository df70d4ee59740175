"""The limits of place and speed on joint motions: forward kinematics along the way, by the rules of control."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import JointSample, Posture, RobotProfile
from roboneuron.errors import RefusedError, UnsafeError
from roboneuron.gate.motion.reach import Reach
from roboneuron.gate.motion.rules import MotionRules
from roboneuron.gate.motion.task_space import TaskSpace

F64 = NDArray[np.float64]

MAX_POSTURES = 20_000
"""Longer ways are refused: judging them would take seconds."""


class LimitError(RefusedError):
    """A motion breaks a limit; `limit` is its name, from `LIMITS`."""

    def __init__(self, limit: str, message: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.limit = limit


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Leg:
    """The way of some joints from where they are to `position`; the others stay.

    Attributes:
        names: the joints that are commanded.
        position: where they go, float64 (n,) [rad or m].
        duration_s: time for it; None when nobody knows, then its speed is not judged.
        velocity: float64 (n,), at the end of the leg, where the command states one: drivers may take a cubic then.
        where: place in the command, for messages.
    """

    names: tuple[str, ...]
    position: F64
    duration_s: float | None
    velocity: F64 | None = None
    where: str = ""


class PathLimiter:
    """Judges ways through joint space for one arm; safe from any thread.

    Between two postures that are looked at, no point of the arm moves farther than twice the least distance of the
    links (5 to 20 mm), and the TCP's way between them is tested as a line, so that neither a zone nor a link is
    passed unseen. Singularities are no limit here: joint motions do not depend on the Jacobian's inverse.

    Args:
        rules: the numbers of `[limits]`; a limit that is broken is refused, whatever its reaction is for actions.
        profile: of the robot, with the `collision` in force.
        inspect: tells a posture's TCP and distances; raises UnsafeError.
    """

    def __init__(self, rules: MotionRules, profile: RobotProfile, inspect: Callable[[JointSample], Posture]) -> None:
        self._rules = rules
        self._task = TaskSpace(rules)
        self._profile = profile
        self._inspect = inspect
        self._reach = Reach(profile)
        self._lock = threading.Lock()

    def check(self, legs: Iterable[Leg], joints: JointSample) -> None:
        """Raise LimitError for the first limit that the way breaks.

        Args:
            legs: one after the other.
            joints: where the arm is; every joint of it.
        """
        worst, told = self._judge(legs, joints, places=True)
        if worst > 1.0:
            raise LimitError("speed", told, hint=f"Give it {math.ceil(worst * 100.0) / 100.0:g} times the time.")

    def slowdown(self, legs: Iterable[Leg], joints: JointSample) -> float:
        """How many times the legs' durations the TCP needs to stay within its speeds, at least 1."""
        return max(1.0, self._judge(legs, joints, places=False)[0])

    def _judge(self, legs: Iterable[Leg], joints: JointSample, *, places: bool) -> tuple[float, str]:
        """Worst ratio of a speed to its limit, and what it is in words."""
        worst, told = 0.0, ""
        finite = np.isfinite(joints.position)
        names = tuple(name for name, good in zip(joints.names, finite.tolist(), strict=True) if good)
        here = np.asarray(joints.position, dtype=np.float64)[finite]
        velocity = np.zeros_like(here)
        left = MAX_POSTURES
        with self._lock:
            try:
                before = self._look(names, here)
                for leg in legs:
                    target, end_velocity = self._target(leg, names, here)
                    ways: list[tuple[F64, F64] | None] = [None]
                    if leg.velocity is not None and leg.duration_s:
                        ways.append((velocity, end_velocity))
                    for slopes in ways:
                        way = target - here
                        ratio, reason, used = self._follow(leg, names, here, way, slopes, before, left, places)
                        left -= used
                        if ratio > worst:
                            worst, told = ratio, reason
                    here, velocity = target, end_velocity
                    before = self._look(names, here)
            except UnsafeError as error:
                raise LimitError("kinematics", f"The motion cannot be judged: {error.message}") from error
        return worst, told

    def _target(self, leg: Leg, names: tuple[str, ...], here: F64) -> tuple[F64, F64]:
        target, velocity = here.copy(), np.zeros_like(here)
        for index, name in enumerate(leg.names):
            if name not in names:
                raise UnsafeError(f"Joint {name!r} is not measured.")
            target[names.index(name)] = leg.position[index]
            if leg.velocity is not None:
                velocity[names.index(name)] = leg.velocity[index]
        return target, velocity

    def _follow(
        self, leg: Leg, names: tuple[str, ...], start: F64, way: F64, slopes: tuple[F64, F64] | None, before: Posture,
        left: int, places: bool,
    ) -> tuple[float, str, int]:  # fmt: skip
        """Look at the postures of one leg; worst speed ratio, what it is, how many were looked at."""
        farthest = np.abs(way)
        if slopes is not None and leg.duration_s is not None:
            farthest = np.maximum(farthest, leg.duration_s * np.maximum(np.abs(slopes[0]), np.abs(slopes[1])) * 1.5)
        count = self._reach.count(names, farthest)
        if count > left:
            raise LimitError("length", "The way is too long to be judged.", hint="Send it in several calls.")
        worst, told = 0.0, ""
        for position in _positions(start, way, slopes, leg.duration_s or 0.0, count):
            there = self._look(names, position)
            if places:
                self._check_place(leg, before, there)
            if leg.duration_s:
                for ratio, reason in self._speeds(before, there, leg.duration_s / count):
                    if ratio > worst:
                        worst, told = ratio, f"{leg.where}{reason}"
            before = there
        return worst, told, count

    def _look(self, names: tuple[str, ...], position: F64) -> Posture:
        posture = self._inspect(JointSample(names=names, position=position))
        if self._profile.collision is not None and posture.near is None:
            raise UnsafeError("the controller tells no distances between links; see limits.collision")
        return posture

    def _check_place(self, leg: Leg, before: Posture, there: Posture) -> None:
        bare = replace(there, smallest_singular_value=None)
        for name, reason in self._task.places(before.pose, bare, lambda: before):
            raise LimitError(name, f"{leg.where}{reason}", hint="Choose another way or another target.")

    def _speeds(self, before: Posture, there: Posture, duration_s: float) -> Iterator[tuple[float, str]]:
        motion = self._task.motion(before.pose, before.pose, there, duration_s, 0.0)
        for value, most, unit in (
            (motion.speed_m_s, self._rules.max_speed_m_s, "m/s"),
            (motion.turn_rad_s, self._rules.max_turn_rad_s, "rad/s"),
        ):
            yield value / most / (1.0 + 1e-6), f"The TCP would move at {value:.3g} {unit}, allowed is {most:g} {unit}."


def _positions(start: F64, way: F64, slopes: tuple[F64, F64] | None, duration_s: float, count: int) -> Iterator[F64]:
    """Postures after the start: on a line, or on the cubic that has the velocities `slopes` at its ends."""
    for number in range(1, count + 1):
        s = number / count
        if slopes is None:
            yield start + way * s
        else:
            bend = slopes[0] * (s * (1.0 - s) ** 2) - slopes[1] * (s * s * (1.0 - s))
            yield start + way * (s * s * (3.0 - 2.0 * s)) + bend * duration_s
