"""Joints, limits and postures of a cell's arms, for their simulation."""

from __future__ import annotations

import numpy as np

from rn_robot_fr3.cell import MOVED, Workcell
from rn_robot_fr3.limits import (
    ACCELERATION_RAD_S2,
    ARM_JOINTS,
    EFFORT_NM,
    FINGER_OPEN_M,
    FINGER_VELOCITY_M_S,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)
from rn_robot_fr3.profile import HOME_RAD
from rn_simulation.arm_cell import ArmCell

_FINGER = len(ARM_JOINTS)
_FINGER_ACCELERATION_M_S2 = 1.0
_FINGER_FORCE_N = 40.0
"""Grasping force of the simulated gripper: well above what a wooden cube needs, below what pushes
the fingers through it.
"""


def arm_cell(cell: Workcell) -> ArmCell:
    """The arms of `cell`."""
    count = len(cell.mounts)
    each = range(0, count * len(MOVED), len(MOVED))
    # the second finger mimics the first
    own = (*range(_FINGER), _FINGER, _FINGER)
    return ArmCell(
        robot=cell.robot,
        arms=tuple(mount.name for mount in cell.mounts),
        joints=cell.joints,
        commanded=cell.commanded,
        followed=tuple(first + number for first in each for number in own),
        grippers=tuple(first + _FINGER for first in each),
        start=np.tile([*HOME_RAD, FINGER_OPEN_M], count),
        lower=np.tile([*LOWER_RAD, 0.0], count),
        upper=np.tile([*UPPER_RAD, FINGER_OPEN_M], count),
        velocity=np.tile([*VELOCITY_RAD_S, FINGER_VELOCITY_M_S], count),
        acceleration=np.tile([*ACCELERATION_RAD_S2, _FINGER_ACCELERATION_M_S2], count),
        force=np.tile([*EFFORT_NM, _FINGER_FORCE_N, _FINGER_FORCE_N], count),
    )
