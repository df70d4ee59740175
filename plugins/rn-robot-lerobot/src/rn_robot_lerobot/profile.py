"""The SO-101's profile: what is true of the robot whichever driver moves it."""

from __future__ import annotations

import numpy as np

from rn_robot_lerobot.arm import (
    ARM_JOINTS,
    BASE_LINK,
    GRIPPER_JOINT,
    HOME_RAD,
    JAW_CLOSED_RAD,
    JAW_LINKS,
    JAW_OPEN_RAD,
    NAME,
    TCP_LINK,
    joint_limits,
    urdf,
)
from rn_robot_lerobot.cameras import cameras
from roboneuron import (
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


def profile() -> RobotProfile:
    """The profile of an SO-101 follower with a camera beside the table and one on the gripper."""
    named = tuple(camera.profile() for camera in cameras())
    return RobotProfile(
        name=NAME,
        urdf=urdf(),
        base_link=BASE_LINK,
        tcp_link=TCP_LINK,
        arm_joints=ARM_JOINTS,
        limits=joint_limits(),
        home_rad=np.array(HOME_RAD),
        gripper=GripperProfile(
            joint=GRIPPER_JOINT, closed_position=JAW_CLOSED_RAD, open_position=JAW_OPEN_RAD
        ),
        cameras=named,
        collision=CollisionProfile(
            min_distance_m=MIN_DISTANCE_M,
            obstacles=(
                Obstacle(
                    name="table", lower_m=np.array(TABLE_LOWER_M), upper_m=np.array(TABLE_UPPER_M)
                ),
            ),
            tool_links=JAW_LINKS,
        ),
        workspace=Workspace(
            lower_m=np.array(WORKSPACE_LOWER_M), upper_m=np.array(WORKSPACE_UPPER_M)
        ),
        endpoints=(
            Endpoint(
                name="joint_trajectory",
                kind="publish",
                topic="joint_trajectory",
                type="trajectory_msgs/msg/JointTrajectory",
                summary=f"Move arm joints {', '.join(ARM_JOINTS)} and the jaw {GRIPPER_JOINT} "
                f"({JAW_CLOSED_RAD} closed .. {JAW_OPEN_RAD} open) [rad].",
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
        ),
        own_topics=("sim/state",),
    )
