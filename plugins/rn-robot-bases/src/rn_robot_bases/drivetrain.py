"""What turns a wanted velocity into wheel motion and wheel motion back into odometry, whatever the
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
    """What the motors are told.

    Attributes:
        velocity: of driven wheels [rad/s].
        position: of steering hinges [rad].
    """

    velocity: JointValues
    position: JointValues


class Drivetrain(Protocol):
    """A platform's motion controller; pure computation, advanced once per physics step, used from
    one thread.
    """

    def aim(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Go for this velocity with the ordinary acceleration; the caller has checked that it is
        possible.
        """
        ...

    def halt(self) -> None:
        """Go for standstill with the stronger deceleration of the brakes."""
        ...

    def advance(self, step_s: float) -> JointTargets:
        """Move the setpoint by one step and return what the motors are to do."""
        ...

    def measure(self, velocity: JointValues, position: JointValues) -> BaseVelocity:
        """Velocity of the base by its wheel encoders: joint velocities [rad/s] and positions
        [rad].
        """
        ...

    @property
    def setpoint(self) -> tuple[float, float]:
        """Velocity asked of the wheels now: forwards [m/s] and turning [rad/s]."""
        ...


def approach(value: float, goal: float, change: float) -> float:
    """Return `value` moved towards `goal` by at most `change` (>= 0)."""
    return max(goal, value - change) if goal < value else min(goal, value + change)
