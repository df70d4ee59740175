"""Velocities that a joint can have on its way through points at times, by its limit of
acceleration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from roboneuron.feature import joint_space


def shortest_s(distance: float, acceleration: float) -> float:
    """Least time from rest to rest over a distance."""
    return 2.0 * math.sqrt(abs(distance) / acceleration)


@dataclass(frozen=True, slots=True)
class Speeds:
    """Velocities that one joint may have at a time, lowest to highest."""

    low: float
    high: float

    def after(
        self, distance: float, duration_s: float, acceleration: float, velocity: float
    ) -> Speeds | None:
        """Velocities after `distance` in `duration_s`, from any of these; None when it cannot be
        covered.

        With |acceleration| <= a, a joint that leaves with u covers the distance d in T if |d - u T|
        <= a T^2 / 2. It ends fastest when it first brakes and then accelerates: u + a (2 sqrt(T^2 /
        2 + (d - u T) / a) - T), slowest the other way round. Both fall with u, so the ends of the
        interval give the ends of the next one.

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
            """Of the velocity, by braking and accelerating: `excess` is the mean above the velocity
            at the start.
            """
            root = math.sqrt(max(0.0, duration_s * duration_s / 2.0 + excess * duration_s / limit))
            return limit * (2.0 * root - duration_s)

        slowest, fastest = (
            max(high - change(high - mean), -velocity),
            min(low + change(mean - low), velocity),
        )
        return Speeds(slowest, fastest) if slowest <= fastest else None

    def at(self, velocity: float, tolerance: float = joint_space.JointLimit.SLACK) -> Speeds | None:
        """Only this velocity; None when it is not among them."""
        return (
            Speeds(velocity, velocity)
            if self.low - tolerance <= velocity <= self.high + tolerance
            else None
        )
