"""Smooth joint setpoints: bounded velocity and acceleration at every change of the target."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_BRAKING_RESERVE = 0.8
"""Share of the acceleration used to plan braking, so that a discrete step does not overshoot."""
_ARRIVED = 1e-7
"""A slow setpoint closer than this [rad or m] is set to its target."""


class JointSetpoint:
    """Setpoints of n joints moving to targets; pure computation, advanced once per physics step.

    Attributes:
        position, velocity, target: float64 (n,) [rad, m, per s].
    """

    def __init__(self, position: F64, velocity_limit: F64, acceleration_limit: F64) -> None:
        """Start at rest at `position`; limits are float64 (n,) and positive."""
        self.position = position.astype(np.float64).copy()
        self.velocity = np.zeros_like(self.position)
        self.target = self.position.copy()
        self._velocity_limit = velocity_limit
        self._acceleration_limit = acceleration_limit
        self._remaining_s = np.zeros_like(self.position)

    def aim(self, target: F64, joints: Sequence[int], duration_s: float) -> None:
        """Move `joints` to their entries of `target` (n,) within `duration_s`, or as soon as the
        limits allow.
        """
        chosen = list(joints)
        self.target[chosen] = target[chosen]
        self._remaining_s[chosen] = duration_s

    def shortest_s(self, target: F64, joints: Sequence[int]) -> float:
        """Shortest time [s] from rest for the slowest of `joints` to reach `target` (n,), with a
        trapezoidal velocity profile.
        """
        chosen = list(joints)
        distance, limit = np.abs(target - self.position)[chosen], self._acceleration_limit[chosen]
        speed = np.minimum(self._velocity_limit[chosen], np.sqrt(distance * limit))
        moving = speed > 0.0
        times = distance[moving] / speed[moving] + speed[moving] / limit[moving]
        return float(times.max(initial=0.0))

    def halt(self, joints: list[int]) -> None:
        """Stop `joints` as fast as their acceleration allows."""
        braking = self.velocity**2 / (2.0 * _BRAKING_RESERVE * self._acceleration_limit)
        self.target[joints] = (self.position + np.sign(self.velocity) * braking)[joints]
        self._remaining_s[joints] = 0.0

    def advance(self, step_s: float) -> None:
        """Move the setpoints by one step."""
        gap = self.target - self.position
        distance = np.abs(gap)
        braking = np.sqrt(2.0 * _BRAKING_RESERVE * self._acceleration_limit * distance)
        wanted = distance / np.maximum(self._remaining_s, step_s)
        wanted = np.sign(gap) * np.minimum(np.minimum(wanted, self._velocity_limit), braking)
        change = self._acceleration_limit * step_s
        was_slow = np.abs(self.velocity) <= change
        self.velocity += np.clip(wanted - self.velocity, -change, change)
        self.position += self.velocity * step_s
        arrived = was_slow & (np.abs(self.target - self.position) < _ARRIVED)
        self.position[arrived] = self.target[arrived]
        self.velocity[arrived] = 0.0
        self._remaining_s = np.maximum(self._remaining_s - step_s, 0.0)
