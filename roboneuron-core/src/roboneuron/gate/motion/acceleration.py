"""Limits of the joints on acceleration, for everybody who sends: a velocity changes by at most the
joint's acceleration times the time that there is for the change.

Who asks knows different things, so there are three questions:

- `Speeds`, of timed points before anything is sent: can a joint follow them at all, and rest at the
  end? Exact, because the time of each point is the command's own.
- `JointAccelerations`, of control's next step: how much of it may be sent? The velocity counts from
  command to command, and the shorter of both times counts, because a command may be replaced before
  its end.
- `change_s`, in front of the driver, where a sender's later commands are not known: how long does
  this one take at least? The time between the middles of both commands counts, the longest that a
  joint can have had. So what passes one of the others is never changed there, and a command that is
  late by the jitter of messages is not either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron.contract import F64
from roboneuron.gate.motion.joint_space import JointLimit, braking_velocity


def shortest_s(distance: float, acceleration: float) -> float:
    """Least time from rest to rest over a distance."""
    return 2.0 * math.sqrt(abs(distance) / acceleration)


def change_s(distance: float, along: float, acceleration: float, since_s: float) -> float:
    """Shortest duration [s] of a command over `distance` for a joint that moves at `along` >= 0
    towards it, by its acceleration.

    The mean velocities of two commands differ by at most the acceleration times the time between
    the middles of the commands. From rest, `since_s` is infinite, the time is that of the command.
    """
    if distance == 0.0 or math.isinf(acceleration):
        return 0.0
    if math.isinf(since_s):
        return math.sqrt(distance / acceleration)
    # distance / t <= along + acceleration * (since_s + t) / 2, solved for t
    half = along + acceleration * since_s / 2.0
    return (math.sqrt(half * half + 2.0 * acceleration * distance) - half) / acceleration


@dataclass(frozen=True, slots=True)
class Speeds:
    """Range of velocities that one joint may have at a time."""

    low: float
    high: float

    def after(
        self, distance: float, duration_s: float, acceleration: float, velocity: float
    ) -> Speeds | None:
        """Velocities after `distance` in `duration_s`, from any of these; None if it cannot be
        covered.

        With |acceleration| <= a, a joint with initial velocity u covers the distance d in T if |d -
        u T| <= a T^2 / 2. It ends fastest when it first brakes and then accelerates: u + a (2
        sqrt(T^2 / 2 + (d - u T) / a) - T), slowest in the opposite order. Both decrease with u, so
        the ends of the interval give the ends of the next one.

        Args:
            distance: signed [rad or m].
            duration_s: above 0.
            acceleration: limit [per s^2]; may be infinite.
            velocity: limit at the end [per s].
        """
        if math.isinf(acceleration):
            return Speeds(-velocity, velocity)
        mean, limit = distance / duration_s, acceleration * (1.0 + JointLimit.SLACK)
        reach = limit * duration_s / 2.0
        low, high = max(self.low, mean - reach), min(self.high, mean + reach)
        if low > high:
            return None

        def change(excess: float) -> float:
            """Change of the velocity by braking and accelerating: `excess` is the mean above the
            initial velocity.
            """
            root = math.sqrt(max(0.0, duration_s * duration_s / 2.0 + excess * duration_s / limit))
            return limit * (2.0 * root - duration_s)

        slowest, fastest = (
            max(high - change(high - mean), -velocity),
            min(low + change(mean - low), velocity),
        )
        return Speeds(slowest, fastest) if slowest <= fastest else None

    def at(self, velocity: float, tolerance: float = JointLimit.SLACK) -> Speeds | None:
        """Restrict to this velocity; None if it is not in the range."""
        return (
            Speeds(velocity, velocity)
            if self.low - tolerance <= velocity <= self.high + tolerance
            else None
        )


class JointAccelerations:
    """Limits of n arm joints on the change from one command to the next; stateless. Arrays are
    float64 (n,).

    Attributes:
        limits: largest acceleration of each joint [per s^2].
    """

    def __init__(self, names: Sequence[str], limits: Sequence[JointLimit]) -> None:
        self._names = names
        # plain floats: for seven joints a loop over them is faster than numpy calls
        self._acceleration = [limit.acceleration for limit in limits]
        self.limits = np.array(self._acceleration)

    def arrival(self, change: F64, goal_velocity: F64, step_s: float) -> tuple[float, str]:
        """The fraction of `change` in `step_s` after which each joint can still stop at its goal,
        and the limiting joint.

        Relative to the goal, which may move, a joint is either slow enough to be stopped by the
        next command, or it brakes from the end of this step on.

        Args:
            change: displacement to the goal.
            goal_velocity: velocity of the goal [per s].
            step_s: time of the step, and of the next one [s].

        Returns:
            The fraction, and "" if it is 1.
        """
        least, joint = 1.0, ""
        for i, (length, moves) in enumerate(
            zip(change.tolist(), goal_velocity.tolist(), strict=True)
        ):
            nearer = length - moves * step_s
            # a goal that approaches by itself is not overtaken
            if nearer * length <= 0.0:
                continue
            hardest = self._acceleration[i]
            stopped = min(abs(nearer) / step_s, hardest * step_s)
            if math.isfinite(hardest):
                stopped = max(stopped, braking_velocity(abs(nearer), 0.0, hardest, step_s))
            share = (moves + math.copysign(stopped, nearer)) * step_s / length
            if share < least - JointLimit.SLACK:
                least, joint = max(0.0, share), self._names[i]
        return least, joint

    def nearest_velocity(self, before: F64, wanted: F64, passed_s: float) -> tuple[F64, str]:
        """The velocity nearest to `wanted` that the joints can reach within `passed_s` after
        `before`, and the limiting joint.

        If possible it is a fraction of `wanted`, so that the direction is kept. If the arm is too
        fast to turn or stop at once, it is the nearest velocity on the line from `before` to
        `wanted`.

        Returns:
            The velocity, and "" if it is `wanted` itself.
        """
        if self.is_reachable(before, wanted, passed_s):
            return wanted, ""
        # Each joint allows an interval of factors s with |s * new - old| <= a_max * dt; the largest
        # factor in all of them is taken.
        least, most, joint = 0.0, 1.0, 0
        for i, (old, new) in enumerate(zip(before.tolist(), wanted.tolist(), strict=True)):
            most_change = self._acceleration[i] * passed_s
            if new == 0.0:
                least = math.inf if abs(old) > most_change else least
                continue
            low, high = sorted(((old - most_change) / new, (old + most_change) / new))
            least = max(least, low)
            if high < most:
                most, joint = high, i
        if least <= most:
            return wanted * most, self._names[joint]
        # No factor is in all of them: on the line between the two velocities, the joint with the
        # least acceleration for its change decides how far the velocity gets.
        change = (wanted - before).tolist()
        parts = [
            self._acceleration[i] * passed_s / abs(c) if c else math.inf
            for i, c in enumerate(change)
        ]
        part = min(parts)
        return before + (wanted - before) * part, self._names[parts.index(part)]

    def is_reachable(self, before: F64, velocity: F64, passed_s: float) -> bool:
        """Return True if the joints can reach `velocity` within `passed_s`: |v - v'| <= a_max * dt.

        Args:
            before, velocity: float64 (n,) [per s].
            passed_s: time in between [s].
        """
        # twice the slack: a velocity that was scaled to the limit passes its second check
        return all(
            abs(new - old) <= most * passed_s * (1.0 + 2 * JointLimit.SLACK) + 1e-12
            for most, old, new in zip(
                self._acceleration, before.tolist(), velocity.tolist(), strict=True
            )
        )
