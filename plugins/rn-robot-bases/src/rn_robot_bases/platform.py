"""The three platforms as data: limits, wheels and descriptions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from rn_robot_bases.ackermann import AckermannDrivetrain, AckermannGeometry
from rn_robot_bases.differential import DifferentialDrivetrain, DifferentialGeometry
from rn_robot_bases.drivetrain import Drivetrain
from rn_simulation.engine import Engine


@dataclass(frozen=True, kw_only=True, slots=True)
class VelocityLimits:
    """Velocities that a base executes; anything beyond is refused, not clamped.

    Attributes:
        backward_m_s, forward_m_s: bounds of the speed; `backward_m_s` is negative.
        turning_rad_s: bound of the turning rate, both ways.
        min_turning_radius_m: smallest turning radius; 0 for a base that turns on the spot.
    """

    backward_m_s: float
    forward_m_s: float
    turning_rad_s: float
    min_turning_radius_m: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Platform:
    """One kind of base.

    Attributes:
        name: as in the descriptor.
        summary: description of the base and its motion, for agents.
        base_link: frame of the odometry, on the ground; its position is given in the geometry.
        limits: velocity limits.
        geometry: wheels and accelerations.
        free_wheels: joints that turn without a motor.
        wheel_torque_nm: torque of each driven wheel.
        is_body_frictionless: the body slides on casters.
        friction: sliding friction between a wheel and the floor.
    """

    name: str
    summary: str
    base_link: str
    limits: VelocityLimits
    geometry: DifferentialGeometry | AckermannGeometry
    free_wheels: tuple[str, ...] = ()
    wheel_torque_nm: float
    is_body_frictionless: bool = False
    friction: float = 1.0

    def drivetrain(self) -> Drivetrain:
        """A new motion controller, at rest."""
        if isinstance(self.geometry, DifferentialGeometry):
            return DifferentialDrivetrain(self.geometry)
        return AckermannDrivetrain(self.geometry)

    @property
    def driven_wheels(self) -> tuple[str, ...]:
        """Joints of driven wheels."""
        if isinstance(self.geometry, DifferentialGeometry):
            return (*self.geometry.left, *self.geometry.right)
        return (self.geometry.rear_left, self.geometry.rear_right)

    @property
    def hinges(self) -> tuple[str, ...]:
        """Steering joints."""
        if isinstance(self.geometry, DifferentialGeometry):
            return ()
        return (self.geometry.hinge_left, self.geometry.hinge_right)

    @property
    def joints(self) -> tuple[str, ...]:
        """Every moving joint: driven wheels, free wheels, hinges."""
        return (*self.driven_wheels, *self.free_wheels, *self.hinges)


DIFFDRIVE = Platform(
    name="diffdrive",
    summary="A small differential-drive base; it turns on the spot.",
    base_link="base_link",
    limits=VelocityLimits(backward_m_s=-0.5, forward_m_s=0.5, turning_rad_s=1.8),
    geometry=DifferentialGeometry(
        left=("left_wheel",),
        right=("right_wheel",),
        wheel_radius_m=0.07,
        track_m=0.32,
        acceleration_m_s2=1.0,
        angular_acceleration_rad_s2=3.0,
        braking_m_s2=2.0,
        angular_braking_rad_s2=6.0,
    ),
    wheel_torque_nm=5.0,
    is_body_frictionless=True,
)
"""The base frame lies on the ground between the wheels."""

_HUSKY_GEOMETRY = DifferentialGeometry(
    left=("front_left_wheel", "rear_left_wheel"),
    right=("front_right_wheel", "rear_right_wheel"),
    wheel_radius_m=0.17775,
    track_m=0.809,
    turning_centre_x_m=-0.157,
    acceleration_m_s2=1.0,
    angular_acceleration_rad_s2=2.0,
    braking_m_s2=2.0,
    angular_braking_rad_s2=4.0,
)
HUSKY = Platform(
    name="husky",
    summary="A four-wheeled skid-steered base; it turns on the spot, about a point 0.16 m behind "
    "its centre.",
    base_link="base_footprint",
    limits=VelocityLimits(backward_m_s=-1.0, forward_m_s=1.0, turning_rad_s=1.2),
    geometry=_HUSKY_GEOMETRY,
    wheel_torque_nm=200.0,
)
"""Each wheel touches the ground in one point; the base frame is below the centre of the base.

`track_m` and `turning_centre_x_m` were measured in PyBullet (geometric track 0.571 m) as means over
seconds of turning; the mean turning rate is then correct within 3 % for all commands in the limits.
Within a turn both vary with the heading.
"""
_HUSKY_IN_MUJOCO = replace(
    HUSKY, friction=0.5, geometry=replace(_HUSKY_GEOMETRY, track_m=0.96, turning_centre_x_m=-0.17)
)
"""The same in MuJoCo, where friction is isotropic: turning also depends on the speed."""

RACECAR = Platform(
    name="racecar",
    summary="A scale model car with Ackermann steering; it cannot turn on the spot.",
    base_link="base_link",
    limits=VelocityLimits(
        backward_m_s=-1.0, forward_m_s=2.0, turning_rad_s=1.5, min_turning_radius_m=0.75
    ),
    geometry=AckermannGeometry(
        rear_left="left_rear_wheel_joint",
        rear_right="right_rear_wheel_joint",
        hinge_left="left_steering_hinge_joint",
        hinge_right="right_steering_hinge_joint",
        wheel_radius_m=0.05,
        track_m=0.2,
        wheelbase_m=0.325,
        acceleration_m_s2=2.0,
        braking_m_s2=4.0,
        steering_rate_rad_s=3.0,
    ),
    free_wheels=("left_front_wheel_joint", "right_front_wheel_joint"),
    wheel_torque_nm=10.0,
)
"""The base frame lies on the ground under the rear axle."""

PLATFORMS: Mapping[str, Platform] = MappingProxyType(
    {p.name: p for p in (DIFFDRIVE, HUSKY, RACECAR)}
)
"""Platform by robot name."""


def in_engine(platform: Platform, engine: Engine) -> Platform:
    """The platform with the parameters for `engine`: the slip of a skid-steered base differs."""
    return _HUSKY_IN_MUJOCO if platform is HUSKY and engine == "mujoco" else platform
