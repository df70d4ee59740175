"""Conversion of a velocity command to wheel motion, and of wheel motion to odometry, for any
platform.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from rn_simulation.planar_motion import BaseVelocity

JointValues = Mapping[str, float]
"""Value by joint name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JointTargets:
    """Setpoints of the motors.

    Attributes:
        velocity: velocity of driven wheels [rad/s].
        position: position of steering hinges [rad].
    """

    velocity: JointValues
    position: JointValues


class Drivetrain(Protocol):
    """A platform's motion controller; pure computation, advanced once per physics step, used from
    one thread.
    """

    def aim(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Set the target velocity, with ordinary acceleration; the caller has checked that it is
        possible.
        """
        ...

    def halt(self) -> None:
        """Brake to a standstill with the stronger deceleration."""
        ...

    def advance(self, step_s: float) -> JointTargets:
        """Advance the setpoint by one step and return the motor setpoints."""
        ...

    def measure(self, velocity: JointValues, position: JointValues) -> BaseVelocity:
        """Velocity of the base from its wheel encoders: joint velocities [rad/s] and positions
        [rad].
        """
        ...

    @property
    def setpoint(self) -> tuple[float, float]:
        """Current setpoint of the velocity: forwards [m/s] and turning [rad/s]."""
        ...


def approach(value: float, goal: float, change: float) -> float:
    """Return `value` moved towards `goal` by at most `change` (>= 0)."""
    return max(goal, value - change) if goal < value else min(goal, value + change)
