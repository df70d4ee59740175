"""Whether a joint can be at given positions at given times: velocities that its acceleration allows, step by step."""

from __future__ import annotations

import math
from dataclasses import dataclass

SLACK = 1e-6
"""Relative: what rounding adds to an acceleration."""


@dataclass(frozen=True, slots=True)
class Speeds:
    """Velocities that one joint may have at a time, lowest to highest."""

    low: float
    high: float

    def after(self, distance: float, duration_s: float, acceleration: float, velocity: float) -> Speeds | None:
        """Velocities after `distance` in `duration_s`, from any of these; None when it cannot be covered.

        With |acceleration| <= a, a joint that leaves with u covers the distance d in T if |d - u T| <= a T^2 / 2. It
        ends fastest when it first brakes and then accelerates: u + a (2 sqrt(T^2 / 2 + (d - u T) / a) - T), slowest
        the other way round. Both fall with u, so the ends of the interval give the ends of the next one.

        Args:
            distance: signed [rad or m].
            duration_s: above 0.
            acceleration: limit [per s^2]; may be infinite.
            velocity: limit at the end [per s].
        """
        mean = distance / duration_s
        if math.isinf(acceleration):
            return Speeds(-velocity, velocity)
        limit = acceleration * (1.0 + SLACK)
        reach = limit * duration_s / 2.0
        low, high = max(self.low, mean - reach), min(self.high, mean + reach)
        if low > high:
            return None
        fastest = low + limit * (2.0 * _root(duration_s, mean - low, limit) - duration_s)
        slowest = high - limit * (2.0 * _root(duration_s, high - mean, limit) - duration_s)
        slowest, fastest = max(slowest, -velocity), min(fastest, velocity)
        return Speeds(slowest, fastest) if slowest <= fastest else None

    def at(self, velocity: float, tolerance: float) -> Speeds | None:
        """Only this velocity; None when it is not among them."""
        return Speeds(velocity, velocity) if self.low - tolerance <= velocity <= self.high + tolerance else None


def _root(duration_s: float, excess: float, limit: float) -> float:
    return math.sqrt(max(0.0, duration_s * duration_s / 2.0 + excess * duration_s / limit))


def shortest_s(distance: float, acceleration: float) -> float:
    """Least time from rest to rest over a distance."""
    return 2.0 * math.sqrt(abs(distance) / acceleration)
