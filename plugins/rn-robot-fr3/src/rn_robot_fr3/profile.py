"""The FR3's profile, valid for every driver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from rn_robot_fr3.cameras import cameras, cell_cameras
from rn_robot_fr3.cell import FACING_M, PAIR
from rn_robot_fr3.description import BASE_LINK, PAIR_BASE_LINK, TCP_LINK, pair_urdf, urdf
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT, FINGER_OPEN_M, joint_limits
from roboneuron import (
    ArmProfile,
    CameraProfile,
    CollisionProfile,
    Endpoint,
    GripperProfile,
    JointLimits,
    Obstacle,
    RobotProfile,
    Workspace,
)

HOME_RAD = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
"""The ready posture: hand straight down, TCP at (0.307, 0, 0.487) m. Source: libfranka examples."""
_RAISED_RAD = (-0.5, 0.0, -1.9, 0.0, 2.0, math.pi / 4)
"""Of the joints after the first: the hand raised to 0.66 m."""
_SWING = ({"fr3_joint5": -0.3}, {"fr3_joint5": 0.3})
WAVE = (
    dict(zip(ARM_JOINTS[1:], _RAISED_RAD, strict=True)),
    *_SWING,
    *_SWING,
    dict(zip(ARM_JOINTS[1:], HOME_RAD[1:], strict=True)),
)
"""The hand swings about the forearm; the first joint stays, so that the arm stays on its side."""

WORKSPACE_LOWER_M = (0.22, -0.45, 0.010)
"""At this lowest TCP height the fingertips, 9 mm beyond the TCP, are still above the table."""
WORKSPACE_UPPER_M = (0.75, 0.45, 0.75)

MIN_DISTANCE_M = 0.01
TABLE_LOWER_M, TABLE_UPPER_M = (-0.30, -0.60, -0.60), (1.00, 0.60, 0.00)
"""The table under the arm, as in `world.py`, and the space below it."""
FINGER_LINKS = ("fr3_leftfinger", "fr3_rightfinger")

OWN_TOPICS = (
    *("sim/state", "sim/clock", "sim/turn", "measured_joint_states", "external_joint_torques"),
    *("external_wrench_in_base_frame", "current_pose", "robot_state"),
)
"""Topics of the simulation and of the control box's driver."""


def _endpoints() -> tuple[Endpoint, ...]:
    return (
        Endpoint(
            name="joint_trajectory",
            kind="publish",
            topic="joint_trajectory",
            type="trajectory_msgs/msg/JointTrajectory",
            summary="Move arm joints fr3_joint1..7 [rad] and the finger fr3_finger_joint1 [m, 0 "
            "closed .. 0.04 open].",
            rate_hz=50.0,
            joint_limited=True,
        ),
        Endpoint(
            name="joint_states",
            kind="read",
            topic="joint_states",
            type="sensor_msgs/msg/JointState",
            summary="Measured positions and velocities of the arm joints and fingers.",
        ),
        Endpoint(
            name="ee_pose",
            kind="read",
            topic="ee_pose",
            type="geometry_msgs/msg/PoseStamped",
            summary="Measured pose of the TCP (between the fingertips) in the base frame.",
        ),
        *(_image(camera.profile()) for camera in cameras()),
    )


def _image(camera: CameraProfile) -> Endpoint:
    return Endpoint(
        name=f"{camera.name}_image",
        kind="read",
        topic=f"camera/{camera.name}/image",
        type="sensor_msgs/msg/Image",
        summary=f"Newest image of the {camera.name} camera.",
    )


def pair_profile() -> RobotProfile:
    """The profile of two FR3s with Franka Hands that face each other at one table."""
    arms = tuple(
        ArmProfile(
            name=mount.name,
            joints=tuple(f"{mount.prefix}{joint}" for joint in ARM_JOINTS),
            base_link=f"{mount.prefix}{BASE_LINK}",
            tcp_link=f"{mount.prefix}{TCP_LINK}",
            gripper=GripperProfile(
                joint=f"{mount.prefix}{FINGER_JOINT}",
                closed_position=0.0,
                open_position=FINGER_OPEN_M,
            ),
        )
        for mount in PAIR.mounts
    )
    one = joint_limits()
    each = {part.name: np.tile(getattr(one, part.name), len(arms)) for part in fields(one)}
    lower_m, upper_m = np.array(TABLE_LOWER_M), np.array(TABLE_UPPER_M)
    upper_m[0] = FACING_M - lower_m[0]
    nearest_m, lowest_m, highest_m = WORKSPACE_LOWER_M[0], WORKSPACE_LOWER_M, WORKSPACE_UPPER_M
    named = tuple(camera.profile() for camera in cell_cameras(PAIR))
    return RobotProfile(
        name=PAIR.robot,
        urdf=pair_urdf(),
        base_link=PAIR_BASE_LINK,
        tcp_link=arms[0].tcp_link,
        arm_joints=PAIR.arm_joints,
        limits=JointLimits(**each),
        home_rad=np.tile(HOME_RAD, len(arms)),
        gripper=arms[0].gripper,
        arms=arms,
        cameras=named,
        collision=CollisionProfile(
            min_distance_m=MIN_DISTANCE_M,
            obstacles=(Obstacle(name="table", lower_m=lower_m, upper_m=upper_m),),
            tool_links=tuple(f"{m.prefix}{link}" for m in PAIR.mounts for link in FINGER_LINKS),
        ),
        workspace=Workspace(
            lower_m=np.array(lowest_m),
            upper_m=np.array([FACING_M - nearest_m, *highest_m[1:]]),
        ),
        endpoints=_pair_endpoints(arms, named),
        own_topics=("sim/state", "sim/handed_over", "sim/clock", "sim/turn"),
    )


def _pair_endpoints(
    arms: Sequence[ArmProfile], named: Sequence[CameraProfile]
) -> tuple[Endpoint, ...]:
    trajectory, states, pose, *_ = _endpoints()
    joints = " and ".join(f"{arm.joints[0]}..7" for arm in arms)
    fingers = " and ".join(arm.gripper.joint for arm in arms if arm.gripper is not None)
    return (
        replace(
            trajectory,
            summary=f"Move arm joints {joints} [rad] and the fingers {fingers} [m, 0 closed .. "
            "0.04 open].",
        ),
        states,
        *(
            replace(
                pose,
                name=f"{arm.name}_ee_pose",
                topic=f"{arm.name}/ee_pose",
                summary=f"Measured pose of the TCP of the {arm.name} arm in the base frame.",
            )
            for arm in arms
        ),
        *map(_image, named),
    )


def profile() -> RobotProfile:
    """The profile of a Franka Research 3 with Franka Hand, a camera next to the table and one at
    the wrist.
    """
    return RobotProfile(
        name="fr3",
        urdf=urdf(),
        base_link=BASE_LINK,
        tcp_link=TCP_LINK,
        arm_joints=ARM_JOINTS,
        limits=joint_limits(),
        home_rad=np.array(HOME_RAD),
        gripper=GripperProfile(
            joint=FINGER_JOINT, closed_position=0.0, open_position=FINGER_OPEN_M
        ),
        cameras=tuple(camera.profile() for camera in cameras()),
        collision=CollisionProfile(
            min_distance_m=MIN_DISTANCE_M,
            obstacles=(
                Obstacle(
                    name="table", lower_m=np.array(TABLE_LOWER_M), upper_m=np.array(TABLE_UPPER_M)
                ),
            ),
            tool_links=FINGER_LINKS,
        ),
        workspace=Workspace(
            lower_m=np.array(WORKSPACE_LOWER_M), upper_m=np.array(WORKSPACE_UPPER_M)
        ),
        endpoints=_endpoints(),
        own_topics=OWN_TOPICS,
        gestures={"wave": WAVE},
    )
