"""Profiles of LeRobot's arms, valid for every driver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rn_robot_lerobot.arm import ARM_JOINTS, GRIPPER_JOINT, KOCH, LEKIWI, SO101, LerobotArm
from rn_robot_lerobot.cameras import cameras
from rn_robot_lerobot.omni_base import BOUNDS
from roboneuron import CameraProfile, CollisionProfile, Endpoint, GripperProfile, RobotProfile
from roboneuron.direct_path.twists import base_endpoints

MIN_DISTANCE_M = 0.005
_UNCALIBRATED = tuple(
    CameraProfile(
        name=name, role=role, frame_id=f"{name}_camera_optical_frame", width=640, height=480
    )
    for name, role in (("front", "primary"), ("wrist", "wrist"))
)
"""Cameras without calibration."""


def so101_profile() -> RobotProfile:
    """Profile of an SO-101 follower with a camera next to the table and one on the gripper."""
    named = [camera.profile() for camera in cameras()]
    return replace(profile_of(SO101, named), own_topics=("sim/state", "sim/clock", "sim/turn"))


def koch_profile() -> RobotProfile:
    """Profile of a Koch v1.1 follower with a camera next to the table and one on the gripper, both
    without calibration.
    """
    return profile_of(KOCH, _UNCALIBRATED)


def lekiwi_profile() -> RobotProfile:
    """Profile of a LeKiwi: an SO-101 on an omnidirectional base, with a camera in front and one on
    the gripper, both without calibration. Poses of the TCP are relative to the base.
    """
    arm = profile_of(LEKIWI, _UNCALIBRATED)
    base = base_endpoints(
        "Drive the base: linear.x forwards and linear.y to the left [m/s], angular.z "
        "counter-clockwise [rad/s]. It drives in every direction and turns on the spot; what is "
        "too fast for a wheel is scaled down as a whole.",
        BOUNDS,
    )
    return replace(arm, endpoints=(*arm.endpoints, *base))


def profile_of(arm: LerobotArm, named: Sequence[CameraProfile]) -> RobotProfile:
    """The profile of an arm with its cameras."""
    return RobotProfile(
        name=arm.name,
        urdf=arm.urdf(),
        base_link=arm.base_link,
        tcp_link=arm.tcp_link,
        arm_joints=ARM_JOINTS,
        limits=arm.joint_limits(),
        home_rad=np.array(arm.home_rad),
        gripper=GripperProfile(
            joint=GRIPPER_JOINT,
            closed_position=arm.jaw_closed_rad,
            open_position=arm.jaw_open_rad,
        ),
        cameras=tuple(named),
        collision=CollisionProfile(
            min_distance_m=MIN_DISTANCE_M, obstacles=(arm.ground,), tool_links=arm.jaw_links
        ),
        workspace=arm.workspace(),
        endpoints=_endpoints(arm, named),
    )


def _endpoints(arm: LerobotArm, named: Sequence[CameraProfile]) -> tuple[Endpoint, ...]:
    return (
        Endpoint(
            name="joint_trajectory",
            kind="publish",
            topic="joint_trajectory",
            type="trajectory_msgs/msg/JointTrajectory",
            summary=f"Move arm joints {', '.join(ARM_JOINTS)} and the jaw {GRIPPER_JOINT} "
            f"({arm.jaw_closed_rad} closed .. {arm.jaw_open_rad} open) [rad].",
            rate_hz=50.0,
            joint_limited=True,
        ),
        Endpoint(
            name="joint_states",
            kind="read",
            topic="joint_states",
            type="sensor_msgs/msg/JointState",
            summary="Measured positions and velocities of the arm joints and the jaw.",
        ),
        Endpoint(
            name="ee_pose",
            kind="read",
            topic="ee_pose",
            type="geometry_msgs/msg/PoseStamped",
            summary="Measured pose of the TCP (between the jaws) in the base frame.",
        ),
        *(
            Endpoint(
                name=f"{camera.name}_image",
                kind="read",
                topic=f"camera/{camera.name}/image",
                type="sensor_msgs/msg/Image",
                summary=f"Newest image of the {camera.name} camera.",
            )
            for camera in named
        ),
    )
