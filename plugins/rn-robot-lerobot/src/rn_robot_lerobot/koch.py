"""The Koch v1.1 follower's joints, limits and postures.

Source of axes, distances and position limits: google-deepmind/mujoco_menagerie,
low_cost_robot_arm. Source of speed and torque: data sheets of XL430-W250 and XL330-M288 at 12 V
and 5 V (61 and 103 turns a minute without load, 1.5 and 0.52 Nm).

Every joint is 0 in the middle of its range, as LeRobot calibrates it, and turns as that of the
same name of the SO-101.
"""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from roboneuron import JointLimits

NAME = "koch"
BASE_LINK, TCP_LINK = "koch_base", "koch_tcp"
ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
"""Names of the arm's joints, base to tip: those of LeRobot's motors."""
GRIPPER_JOINT = "gripper"
JOINTS = (*ARM_JOINTS, GRIPPER_JOINT)
"""In the order of the motors' numbers 1..6."""
JAW_LINKS = ("koch_gripper", "koch_moving_jaw")

LOWER_RAD = (-2.2, -1.085, -1.51, -2.0, -3.14)
UPPER_RAD = (2.2, 1.085, 1.51, 2.0, 3.14)
VELOCITY_RAD_S = (3.0,) * 5
"""Half of the slower motors' speed without load."""
ACCELERATION_RAD_S2 = (20.0,) * 5
"""An estimate: LeRobot has the motors accelerate as fast as they can."""
EFFORT_NM = (1.5, 1.5, 0.52, 0.52, 0.52)

JAW_CLOSED_RAD, JAW_OPEN_RAD = 0.0, 1.6
JAW_VELOCITY_RAD_S = 3.0
JAW_ACCELERATION_RAD_S2 = 20.0

HOME_RAD = (0.0, -0.4, -0.1, 1.645, 0.0)
"""Gripper down, TCP 65 mm above the table."""


def urdf() -> str:
    """XML text of `data/koch.urdf`: published kinematics and limits, shapes of boxes, no mesh
    files.
    """
    return files("rn_robot_lerobot").joinpath("data/koch.urdf").read_text(encoding="utf-8")


def joint_limits() -> JointLimits:
    """The limits of the five arm joints, in the order of `ARM_JOINTS`."""
    return JointLimits(
        lower=np.array(LOWER_RAD),
        upper=np.array(UPPER_RAD),
        velocity=np.array(VELOCITY_RAD_S),
        acceleration=np.array(ACCELERATION_RAD_S2),
        effort=np.array(EFFORT_NM),
    )
