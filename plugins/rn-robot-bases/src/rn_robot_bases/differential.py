"""Drivetrain of bases with two or four wheels that turn by different speeds of their sides."""

from __future__ import annotations

from dataclasses import dataclass

from rn_robot_bases.drivetrain import JointTargets, JointValues, approach
from rn_simulation.planar_motion import BaseVelocity


@dataclass(frozen=True, kw_only=True, slots=True)
class DifferentialGeometry:
    """Wheels of a differential or skid-steered base, and its acceleration limits.

    Attributes:
        left, right: joints of the driven wheels of each side; positive velocity drives forwards.
        wheel_radius_m: rolling radius.
        track_m: effective distance between the sides, from measured turning; on skid-steer bases it
            is larger than the geometric one, because the wheels slip sideways.
        turning_centre_x_m: position of the turning centre on the longitudinal axis, in the base
            frame; 0 without slip. Source of both: Mandow et al. 2007, "Experimental kinematics for
            wheeled skid-steer mobile robots".
        acceleration_m_s2, angular_acceleration_rad_s2: accelerations of ordinary motion.
        braking_m_s2, angular_braking_rad_s2: decelerations of a stop.
    """

    left: tuple[str, ...]
    right: tuple[str, ...]
    wheel_radius_m: float
    track_m: float
    turning_centre_x_m: float = 0.0
    acceleration_m_s2: float
    angular_acceleration_rad_s2: float
    braking_m_s2: float
    angular_braking_rad_s2: float


class DifferentialDrivetrain:
    """Follows the protocol `Drivetrain`."""

    def __init__(self, geometry: DifferentialGeometry) -> None:
        """Start at rest."""
        self._geometry = geometry
        self._linear = self._angular = 0.0
        self._goal = (0.0, 0.0)
        self._is_braking = False

    @property
    def setpoint(self) -> tuple[float, float]:
        """See `Drivetrain.setpoint`."""
        return self._linear, self._angular

    def aim(self, linear_m_s: float, angular_rad_s: float) -> None:
        """See `Drivetrain.aim`."""
        self._goal, self._is_braking = (linear_m_s, angular_rad_s), False

    def halt(self) -> None:
        """See `Drivetrain.halt`."""
        self._goal, self._is_braking = (0.0, 0.0), True

    def advance(self, step_s: float) -> JointTargets:
        """See `Drivetrain.advance`."""
        own = self._geometry
        linear = own.braking_m_s2 if self._is_braking else own.acceleration_m_s2
        angular = (
            own.angular_braking_rad_s2 if self._is_braking else own.angular_acceleration_rad_s2
        )
        self._linear = approach(self._linear, self._goal[0], linear * step_s)
        self._angular = approach(self._angular, self._goal[1], angular * step_s)
        side = self._angular * own.track_m / 2.0
        left, right = (
            (self._linear - side) / own.wheel_radius_m,
            (self._linear + side) / own.wheel_radius_m,
        )
        return JointTargets(
            velocity={**dict.fromkeys(own.left, left), **dict.fromkeys(own.right, right)},
            position={},
        )

    def measure(self, velocity: JointValues, position: JointValues) -> BaseVelocity:
        """See `Drivetrain.measure`."""
        own = self._geometry
        left = own.wheel_radius_m * sum(velocity[name] for name in own.left) / len(own.left)
        right = own.wheel_radius_m * sum(velocity[name] for name in own.right) / len(own.right)
        angular = (right - left) / own.track_m
        return BaseVelocity(
            linear_x=(left + right) / 2.0,
            linear_y=-own.turning_centre_x_m * angular,
            angular_z=angular,
        )
