"""LeKiwi's base: three omnidirectional wheels, and the conversion of a velocity. Pure
computation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

WHEELS = ("base_left_wheel", "base_back_wheel", "base_right_wheel")
"""Motors 7, 8 and 9 of LeRobot."""
WHEEL_RADIUS_M, BASE_RADIUS_M = 0.05, 0.125
WHEEL_LIMIT_RAD_S = 3000 / 4096 * 2.0 * np.pi
"""LeRobot's maximum speed of a wheel, 3000 steps per second."""
_ROLLS_TOWARDS_RAD = np.radians((150.0, -90.0, 30.0))
"""Direction in which a wheel with positive speed moves the base: its mounting angle plus 90
degrees.
"""
_TO_WHEELS = (
    np.stack(
        (
            np.cos(_ROLLS_TOWARDS_RAD),
            np.sin(_ROLLS_TOWARDS_RAD),
            np.full(len(WHEELS), BASE_RADIUS_M),
        ),
        axis=1,
    )
    / WHEEL_RADIUS_M
)
"""Source of radii, angles and limit: lerobot, robots/lekiwi."""
_TO_BASE = np.linalg.inv(_TO_WHEELS)

BOUNDS = {"linear.x": (-0.2, 0.2), "linear.y": (-0.2, 0.2), "angular.z": (-1.0, 1.0)}
"""Bounds of a velocity command, in the base frame [m/s, rad/s]."""
_ACCELERATION, _BRAKING = np.array((0.5, 0.5, 2.5)), np.array((1.0, 1.0, 5.0))
"""Accelerations of ordinary motion, decelerations of a stop [m/s^2, rad/s^2]. Estimates, low enough
that the arm does not sway.
"""


def wheel_speeds(velocity: F64) -> F64:
    """Wheel speeds, float64 (3,) [rad/s], for a base velocity x, y, turning [m/s, rad/s]."""
    speeds: F64 = _TO_WHEELS @ velocity
    return speeds


def base_velocity(speeds: F64) -> F64:
    """Base velocity x, y, turning, float64 (3,) [m/s, rad/s], of wheels that do not slip."""
    velocity: F64 = _TO_BASE @ speeds
    return velocity


def possible(velocity: F64) -> F64:
    """Return `velocity`, scaled down so that no wheel exceeds its limit."""
    fastest = float(np.abs(wheel_speeds(velocity)).max())
    return velocity * min(1.0, WHEEL_LIMIT_RAD_S / fastest) if fastest > 0.0 else velocity


class BaseSetpoint:
    """Ramp of the velocity sent to the wheels towards the commanded one. Used from one thread at a
    time.

    Attributes:
        velocity: current velocity, float64 (3,): x, y, turning [m/s, rad/s].
        motion: "driving", "standing", or "stopping" with the reason.
    """

    def __init__(self, timeout_s: float) -> None:
        """Args:
        timeout_s: time without a command after which it brakes.
        """
        self._timeout_s = timeout_s
        self._goal = np.zeros(3)
        self._commanded_s: float | None = None
        self.velocity = np.zeros(3)
        self.motion = "standing"

    @property
    def is_still(self) -> bool:
        """True if current and target velocity are zero."""
        return not (self.velocity.any() or self._goal.any())

    def aim(self, velocity: F64, now_s: float) -> None:
        """Set the target velocity until the next command, or the timeout."""
        self._goal, self._commanded_s = possible(velocity), now_s
        self.motion = "driving" if velocity.any() else "standing"

    def halt(self, reason: str) -> None:
        """Brake to a standstill."""
        if not self.is_still:
            self.motion = f"stopping: {reason}"
        self._goal, self._commanded_s = np.zeros(3), None

    def drop(self) -> None:
        """Reset after an immediate stop of the wheels."""
        self._goal, self._commanded_s, self.velocity = np.zeros(3), None, np.zeros(3)

    def advance(self, step_s: float, now_s: float) -> None:
        """Advance by one step."""
        if self._commanded_s is not None and now_s - self._commanded_s > self._timeout_s:
            self.halt(f"no command for {self._timeout_s:g} s")
        most = _BRAKING if self._commanded_s is None else _ACCELERATION
        change = self._goal - self.velocity
        self.velocity = self.velocity + np.clip(change, -most * step_s, most * step_s)
