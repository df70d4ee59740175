"""Profiles of the bases, and what their velocity commands must obey."""

from __future__ import annotations

from rn_robot_bases.platform import DIFFDRIVE, HUSKY, RACECAR, Platform
from rn_standard.direct_path.twists import TWIST_FIELDS
from rn_standard.direct_path.twists import check_twist as check_endpoint_twist
from roboneuron import Endpoint, RobotProfile

CMD_VEL = "cmd_vel"
"""Topic of velocity commands, geometry_msgs/Twist in the base frame."""
ODOMETRY = "odom"
"""Topic of odometry, nav_msgs/Odometry."""


def velocity_endpoint(platform: Platform) -> Endpoint:
    """The endpoint that drives the base."""
    limits = platform.limits
    bounds = dict.fromkeys(TWIST_FIELDS, (0.0, 0.0)) | {
        "linear.x": (limits.backward_m_s, limits.forward_m_s),
        "angular.z": (-limits.turning_rad_s, limits.turning_rad_s),
    }
    return Endpoint(
        name="velocity",
        kind="publish",
        topic=CMD_VEL,
        type="geometry_msgs/msg/Twist",
        summary=(
            "Drive the base: linear.x forwards [m/s], angular.z counter-clockwise [rad/s]. "
            f"{platform.summary} "
            "It stops by itself when commands cease."
        ),
        bounds=bounds,
        rate_hz=50.0,
        stop_message="zero",
        min_turning_radius_m=limits.min_turning_radius_m,
        repeat_hz=10.0,
    )


def check_twist(platform: Platform, linear_m_s: float, angular_rad_s: float) -> None:
    """Raise RefusedError, with the reason, unless `platform` can drive at this speed and turning
    rate.
    """
    check_endpoint_twist(
        velocity_endpoint(platform), {"linear.x": linear_m_s, "angular.z": angular_rad_s}
    )


def _profile(platform: Platform) -> RobotProfile:
    odometry = Endpoint(
        name="odometry",
        kind="read",
        topic=ODOMETRY,
        type="nav_msgs/msg/Odometry",
        summary="Pose since the start by wheel encoders [m, rad], which drifts slowly, and "
        "velocity in the base frame.",
    )
    wheels = Endpoint(
        name="joint_states",
        kind="read",
        topic="joint_states",
        type="sensor_msgs/msg/JointState",
        summary="Measured angles [rad] and velocities [rad/s] of the wheels and steering hinges.",
    )
    return RobotProfile(
        name=platform.name,
        base_link=platform.base_link,
        endpoints=(velocity_endpoint(platform), odometry, wheels),
    )


def diffdrive_profile() -> RobotProfile:
    """The profile of the differential-drive base."""
    return _profile(DIFFDRIVE)


def husky_profile() -> RobotProfile:
    """The profile of the skid-steered base."""
    return _profile(HUSKY)


def racecar_profile() -> RobotProfile:
    """The profile of the car."""
    return _profile(RACECAR)
