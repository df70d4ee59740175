"""Profiles of the bases, and limits of their velocity commands."""

from __future__ import annotations

from rn_robot_bases.platform import DIFFDRIVE, HUSKY, RACECAR, Platform
from rn_simulation.ground_truth import TRUE_POSE_TOPIC
from roboneuron import Endpoint, RobotProfile
from roboneuron.direct_path.twists import base_endpoints
from roboneuron.direct_path.twists import check_twist as check_endpoint_twist


def endpoints(platform: Platform) -> tuple[Endpoint, Endpoint]:
    """The endpoints of velocity commands and of odometry."""
    limits = platform.limits
    return base_endpoints(
        "Drive the base: linear.x forwards [m/s], angular.z counter-clockwise [rad/s]. "
        f"{platform.summary}",
        {
            "linear.x": (limits.backward_m_s, limits.forward_m_s),
            "angular.z": (-limits.turning_rad_s, limits.turning_rad_s),
        },
        min_turning_radius_m=limits.min_turning_radius_m,
    )


def check_twist(platform: Platform, linear_m_s: float, angular_rad_s: float) -> None:
    """Raise RefusedError, with the reason, unless `platform` can drive at this speed and turning
    rate.
    """
    check_endpoint_twist(
        endpoints(platform)[0], {"linear.x": linear_m_s, "angular.z": angular_rad_s}
    )


def _profile(platform: Platform) -> RobotProfile:
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
        endpoints=(*endpoints(platform), wheels),
        own_topics=(TRUE_POSE_TOPIC,),
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
