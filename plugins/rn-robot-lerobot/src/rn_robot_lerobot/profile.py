"""The profiles of SO-101 and Koch arm: what is true of a robot whichever driver moves it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rn_robot_lerobot import arm as so101
from rn_robot_lerobot import koch
from rn_robot_lerobot.cameras import cameras
from roboneuron import (
    CameraProfile,
    CollisionProfile,
    Endpoint,
    GripperProfile,
    Obstacle,
    RobotProfile,
    Workspace,
)

WORKSPACE_LOWER_M, WORKSPACE_UPPER_M = (0.08, -0.30, 0.010), (0.36, 0.30, 0.42)
"""At the lowest TCP height the tips of the jaws, 8 mm beyond the TCP, are still above the table."""
MIN_DISTANCE_M = 0.005
TABLE_LOWER_M, TABLE_UPPER_M = (-0.20, -0.40, -0.60), (0.50, 0.40, 0.00)
KOCH_WORKSPACE_LOWER_M, KOCH_WORKSPACE_UPPER_M = (0.05, -0.22, 0.010), (0.27, 0.22, 0.25)


def profile() -> RobotProfile:
    """The profile of an SO-101 follower with a camera beside the table and one on the gripper."""
    named = tuple(camera.profile() for camera in cameras())
    return RobotProfile(
        name=so101.NAME,
        urdf=so101.urdf(),
        base_link=so101.BASE_LINK,
        tcp_link=so101.TCP_LINK,
        arm_joints=so101.ARM_JOINTS,
        limits=so101.joint_limits(),
        home_rad=np.array(so101.HOME_RAD),
        gripper=GripperProfile(
            joint=so101.GRIPPER_JOINT,
            closed_position=so101.JAW_CLOSED_RAD,
            open_position=so101.JAW_OPEN_RAD,
        ),
        cameras=named,
        collision=_collision(so101.JAW_LINKS),
        workspace=Workspace(
            lower_m=np.array(WORKSPACE_LOWER_M), upper_m=np.array(WORKSPACE_UPPER_M)
        ),
        endpoints=_endpoints(so101.JAW_CLOSED_RAD, so101.JAW_OPEN_RAD, named),
        own_topics=("sim/state",),
    )


def koch_profile() -> RobotProfile:
    """The profile of a Koch v1.1 follower with a camera beside the table and one on the gripper,
    which nobody has calibrated.
    """
    named = tuple(
        CameraProfile(
            name=name, role=role, frame_id=f"{name}_camera_optical_frame", width=640, height=480
        )
        for name, role in (("front", "primary"), ("wrist", "wrist"))
    )
    return RobotProfile(
        name=koch.NAME,
        urdf=koch.urdf(),
        base_link=koch.BASE_LINK,
        tcp_link=koch.TCP_LINK,
        arm_joints=koch.ARM_JOINTS,
        limits=koch.joint_limits(),
        home_rad=np.array(koch.HOME_RAD),
        gripper=GripperProfile(
            joint=koch.GRIPPER_JOINT,
            closed_position=koch.JAW_CLOSED_RAD,
            open_position=koch.JAW_OPEN_RAD,
        ),
        cameras=named,
        collision=_collision(koch.JAW_LINKS),
        workspace=Workspace(
            lower_m=np.array(KOCH_WORKSPACE_LOWER_M), upper_m=np.array(KOCH_WORKSPACE_UPPER_M)
        ),
        endpoints=_endpoints(koch.JAW_CLOSED_RAD, koch.JAW_OPEN_RAD, named),
    )


def _collision(jaw_links: tuple[str, ...]) -> CollisionProfile:
    """The table that the arm stands on, and what is below it."""
    lower_m, upper_m = np.array(TABLE_LOWER_M), np.array(TABLE_UPPER_M)
    return CollisionProfile(
        min_distance_m=MIN_DISTANCE_M,
        obstacles=(Obstacle(name="table", lower_m=lower_m, upper_m=upper_m),),
        tool_links=jaw_links,
    )


def _endpoints(
    closed_rad: float, open_rad: float, named: Sequence[CameraProfile]
) -> tuple[Endpoint, ...]:
    return (
        Endpoint(
            name="joint_trajectory",
            kind="publish",
            topic="joint_trajectory",
            type="trajectory_msgs/msg/JointTrajectory",
            summary=f"Move arm joints {', '.join(so101.ARM_JOINTS)} and the jaw "
            f"{so101.GRIPPER_JOINT} ({closed_rad} closed .. {open_rad} open) [rad].",
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
