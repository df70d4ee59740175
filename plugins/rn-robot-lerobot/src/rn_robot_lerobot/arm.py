"""The SO-101's joints, limits and postures.

Source of axes, distances and position limits: TheRobotStudio/SO-ARM100, Simulation/SO101,
so101_new_calib. Source of speed and torque: data sheet of the STS3215 at 7.4 V (0.222 s for 60
degrees without load, 19 kg cm).
"""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from roboneuron import JointLimits

NAME = "so101"
BASE_LINK, TCP_LINK = "so101_base", "so101_tcp"
ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
"""Names of the arm's joints, base to tip: those of LeRobot's motors."""
GRIPPER_JOINT = "gripper"
"""The moving jaw, which turns."""
JOINTS = (*ARM_JOINTS, GRIPPER_JOINT)
"""Every joint, in the order of all joint arrays of this package and of the motors' numbers 1..6."""
JAW_LINKS = ("so101_gripper", "so101_moving_jaw")

LOWER_RAD = (-1.91986, -1.74533, -1.69, -1.65806, -2.74385)
UPPER_RAD = (1.91986, 1.74533, 1.69, 1.65806, 2.84121)
VELOCITY_RAD_S = (3.0,) * 5
"""Two thirds of the speed without load."""
ACCELERATION_RAD_S2 = (20.0,) * 5
"""An estimate: LeRobot has the motors accelerate as fast as they can."""
EFFORT_NM = (1.9,) * 5

JAW_CLOSED_RAD, JAW_OPEN_RAD = -0.174533, 1.74533
JAW_VELOCITY_RAD_S = 3.0
JAW_ACCELERATION_RAD_S2 = 20.0
JAW_EFFORT_NM = 0.5
"""LeRobot limits the gripper's motor; this is 6 N at the tip."""

HOME_RAD = (0.0, 0.05, -0.1, 1.62, 0.0)
"""Gripper down to within a tenth of a degree, above the middle of the table."""


def urdf() -> str:
    """XML text of `data/so101.urdf`: published kinematics and limits, shapes of boxes, no mesh
    files.
    """
    return files("rn_robot_lerobot").joinpath("data/so101.urdf").read_text(encoding="utf-8")


def joint_limits() -> JointLimits:
    """The limits of the five arm joints, in the order of `ARM_JOINTS`."""
    return JointLimits(
        lower=np.array(LOWER_RAD),
        upper=np.array(UPPER_RAD),
        velocity=np.array(VELOCITY_RAD_S),
        acceleration=np.array(ACCELERATION_RAD_S2),
        effort=np.array(EFFORT_NM),
    )
