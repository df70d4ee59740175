"""Drivetrain of a car: driven rear wheels, and front wheels steered about a common centre."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rn_robot_bases.drivetrain import JointTargets, JointValues, approach
from rn_simulation.planar_motion import BaseVelocity


@dataclass(frozen=True, kw_only=True, slots=True)
class AckermannGeometry:
    """Wheels of a car and their rate limits; the base frame is below the middle of the rear axle.

    Attributes:
        rear_left, rear_right: joints of the driven wheels; positive velocity drives forwards.
        hinge_left, hinge_right: joints that steer the front wheels; a positive angle steers to the
            left.
        wheel_radius_m: rolling radius.
        track_m: distance between left and right wheels.
        wheelbase_m: distance between the axles.
        acceleration_m_s2, braking_m_s2: acceleration of ordinary motion, deceleration of a stop.
        steering_rate_rad_s: steering rate of the front wheels.
    """

    rear_left: str
    rear_right: str
    hinge_left: str
    hinge_right: str
    wheel_radius_m: float
    track_m: float
    wheelbase_m: float
    acceleration_m_s2: float
    braking_m_s2: float
    steering_rate_rad_s: float


class AckermannDrivetrain:
    """Follows the protocol `Drivetrain`; steering angle and speed change at bounded rates, so the
    path stays drivable.

    The steering angle is that of a virtual wheel in the middle of the front axle: tan(angle) =
    wheelbase * curvature. At standstill it keeps its angle.
    """

    def __init__(self, geometry: AckermannGeometry) -> None:
        """Start at rest with straight wheels."""
        self._geometry = geometry
        self._linear = self._steering = 0.0
        self._goal_linear = self._goal_steering = 0.0
        self._is_braking = False

    @property
    def setpoint(self) -> tuple[float, float]:
        """See `Drivetrain.setpoint`."""
        return self._linear, self._linear * math.tan(self._steering) / self._geometry.wheelbase_m

    def aim(self, linear_m_s: float, angular_rad_s: float) -> None:
        """See `Drivetrain.aim`."""
        self._goal_linear, self._is_braking = linear_m_s, False
        if linear_m_s != 0.0:
            self._goal_steering = math.atan(self._geometry.wheelbase_m * angular_rad_s / linear_m_s)

    def halt(self) -> None:
        """See `Drivetrain.halt`."""
        self._goal_linear, self._is_braking = 0.0, True

    def advance(self, step_s: float) -> JointTargets:
        """See `Drivetrain.advance`."""
        own = self._geometry
        change = own.braking_m_s2 if self._is_braking else own.acceleration_m_s2
        self._linear = approach(self._linear, self._goal_linear, change * step_s)
        self._steering = approach(
            self._steering, self._goal_steering, own.steering_rate_rad_s * step_s
        )
        curvature = math.tan(self._steering) / own.wheelbase_m
        rear: dict[str, float] = {}
        hinges: dict[str, float] = {}
        sides = ((own.rear_left, own.hinge_left, 0.5), (own.rear_right, own.hinge_right, -0.5))
        for wheel, hinge, side in sides:
            nearness = 1.0 - curvature * side * own.track_m
            rear[wheel] = self._linear * nearness / own.wheel_radius_m
            hinges[hinge] = math.atan2(own.wheelbase_m * curvature, nearness)
        return JointTargets(velocity=rear, position=hinges)

    def measure(self, velocity: JointValues, position: JointValues) -> BaseVelocity:
        """See `Drivetrain.measure`; speed from the rear wheels, curvature from the measured
        steering angles.
        """
        own = self._geometry
        linear = own.wheel_radius_m * (velocity[own.rear_left] + velocity[own.rear_right]) / 2.0
        left, right = math.tan(position[own.hinge_left]), math.tan(position[own.hinge_right])
        half_track = own.track_m / 2.0
        curvature = (
            left / (own.wheelbase_m + half_track * left)
            + right / (own.wheelbase_m - half_track * right)
        ) / 2.0
        return BaseVelocity(linear_x=linear, linear_y=0.0, angular_z=linear * curvature)
