"""Reachable velocities of a joint on its way through timed points, by its acceleration limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from roboneuron.gate.motion import joint_space


def shortest_s(distance: float, acceleration: float) -> float:
    """Least time from rest to rest over a distance."""
    return 2.0 * math.sqrt(abs(distance) / acceleration)


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
        mean, limit = distance / duration_s, acceleration * (1.0 + joint_space.JointLimit.SLACK)
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

    def at(self, velocity: float, tolerance: float = joint_space.JointLimit.SLACK) -> Speeds | None:
        """Restrict to this velocity; None if it is not in the range."""
        return (
            Speeds(velocity, velocity)
            if self.low - tolerance <= velocity <= self.high + tolerance
            else None
        )
