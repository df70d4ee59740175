"""LeKiwi's base: three omnidirectional wheels, and what they make of a wanted velocity. Pure
computation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

WHEELS = ("base_left_wheel", "base_back_wheel", "base_right_wheel")
"""LeRobot's motors 7, 8 and 9."""
WHEEL_RADIUS_M, BASE_RADIUS_M = 0.05, 0.125
WHEEL_LIMIT_RAD_S = 3000 / 4096 * 2.0 * np.pi
"""LeRobot sends no wheel more than 3000 steps a second."""
_ROLLS_TOWARDS_RAD = np.radians((150.0, -90.0, 30.0))
"""Where a wheel moves the base when it turns positively: 90 degrees on from where it sits."""
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
"""What a velocity command may ask, in the base frame [m/s, rad/s]."""
_ACCELERATION, _BRAKING = np.array((0.5, 0.5, 2.5)), np.array((1.0, 1.0, 5.0))
"""Of ordinary motion and of a stop [m/s^2, rad/s^2]. Estimates: the arm on it should not sway."""


def wheel_speeds(velocity: F64) -> F64:
    """Speeds of the wheels, float64 (3,) [rad/s], of a base velocity x, y, turning [m/s, rad/s]."""
    speeds: F64 = _TO_WHEELS @ velocity
    return speeds


def base_velocity(speeds: F64) -> F64:
    """The base velocity x, y, turning, float64 (3,) [m/s, rad/s], of wheels that do not slip."""
    velocity: F64 = _TO_BASE @ speeds
    return velocity


def possible(velocity: F64) -> F64:
    """`velocity`, or as much of it in the same direction as the fastest wheel can do."""
    fastest = float(np.abs(wheel_speeds(velocity)).max())
    return velocity * min(1.0, WHEEL_LIMIT_RAD_S / fastest) if fastest > 0.0 else velocity


class BaseSetpoint:
    """The velocity that is sent to the wheels, on its way to the one that was commanded. Used from
    one thread at a time.

    Attributes:
        velocity: sent now, float64 (3,): x, y, turning [m/s, rad/s].
        motion: "driving", "standing", or "stopping" and why.
    """

    def __init__(self, timeout_s: float) -> None:
        """Args:
        timeout_s: it brakes when no command came for this long.
        """
        self._timeout_s = timeout_s
        self._goal = np.zeros(3)
        self._commanded_s: float | None = None
        self.velocity = np.zeros(3)
        self.motion = "standing"

    @property
    def is_still(self) -> bool:
        """Nothing is asked of the wheels, now or later."""
        return not (self.velocity.any() or self._goal.any())

    def aim(self, velocity: F64, now_s: float) -> None:
        """Go for a velocity until the next command, or until the time is over."""
        self._goal, self._commanded_s = possible(velocity), now_s
        self.motion = "driving" if velocity.any() else "standing"

    def halt(self, reason: str) -> None:
        """Brake to a standstill."""
        if not self.is_still:
            self.motion = f"stopping: {reason}"
        self._goal, self._commanded_s = np.zeros(3), None

    def drop(self) -> None:
        """The wheels were stopped at once."""
        self._goal, self._commanded_s, self.velocity = np.zeros(3), None, np.zeros(3)

    def advance(self, step_s: float, now_s: float) -> None:
        """Move on by one step."""
        if self._commanded_s is not None and now_s - self._commanded_s > self._timeout_s:
            self.halt(f"no command for {self._timeout_s:g} s")
        most = _BRAKING if self._commanded_s is None else _ACCELERATION
        change = self._goal - self.velocity
        self.velocity = self.velocity + np.clip(change, -most * step_s, most * step_s)
