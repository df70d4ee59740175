"""Official limits of the FR3's joints, constant and depending on position.

Source: frankarobotics/franka_description@566ba44 robots/fr3/joint_limits.yaml (position, velocity,
effort); libfranka include/franka/rate_limiting.h (acceleration, jerk, velocity as a function of
position).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron import JointLimits

F64 = NDArray[np.float64]

ARM_JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))
"""Names of the arm's joints, base to tip."""

LOWER_RAD = (-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159)
UPPER_RAD = (2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159)
VELOCITY_RAD_S = (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26)
ACCELERATION_RAD_S2 = (10.0,) * 7
JERK_RAD_S3 = (5000.0,) * 7
EFFORT_NM = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)

BRAKING_OFFSET_RAD_S = (0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35)
"""Velocity that the controller keeps in reserve near a position limit."""
BRAKING_DECELERATION_RAD_S2 = (6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0)
"""Deceleration with which a joint must be able to stop before its position limit."""

FINGER_JOINT = "fr3_finger_joint1"
"""The gripper's commanded joint: travel of one finger."""
MIMIC_FINGER_JOINT = "fr3_finger_joint2"
"""The other finger, which mimics it."""
FINGER_OPEN_M = 0.04
FINGER_VELOCITY_M_S = 0.05
"""Travel speed of one finger. Source: Franka Hand data sheet."""
FINGER_EFFORT_N = 70.0
"""Continuous grasping force. Source: Franka Hand data sheet."""


def joint_limits() -> JointLimits:
    """The limits of the seven arm joints [rad, rad/s, rad/s^2, Nm], in the order of
    `ARM_JOINTS`.
    """
    return JointLimits(
        lower=np.array(LOWER_RAD),
        upper=np.array(UPPER_RAD),
        velocity=np.array(VELOCITY_RAD_S),
        acceleration=np.array(ACCELERATION_RAD_S2),
        effort=np.array(EFFORT_NM),
        braking_offset=np.array(BRAKING_OFFSET_RAD_S),
        braking_deceleration=np.array(BRAKING_DECELERATION_RAD_S2),
    )


def velocity_bounds(position_rad: F64) -> tuple[F64, F64]:
    """Lowest and highest joint velocity, each float64 (7,) [rad/s], that the arm accepts at
    `position_rad` (7,).

    The bound towards a limit is min(vmax, max(0, -offset + sqrt(2 * deceleration * distance to the
    limit))); beyond the limit it is 0. Source: libfranka rate_limiting.h,
    computeUpperLimitsJointVelocity.
    """
    offset, deceleration = np.array(BRAKING_OFFSET_RAD_S), np.array(BRAKING_DECELERATION_RAD_S2)
    fastest = np.array(VELOCITY_RAD_S)

    def towards(distance_rad: F64) -> F64:
        braking = np.sqrt(2.0 * deceleration * np.maximum(distance_rad, 0.0)) - offset
        bound: F64 = np.clip(braking, 0.0, fastest)
        return bound

    return -towards(position_rad - np.array(LOWER_RAD)), towards(np.array(UPPER_RAD) - position_rad)
