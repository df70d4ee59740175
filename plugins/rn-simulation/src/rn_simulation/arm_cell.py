"""Description of a simulated cell of one or several arms, as data: joints, limits, postures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_simulation.ground_truth import LIFTED_M

F64 = NDArray[np.float64]

STEP_S = 1.0 / 240.0
"""Simulation step of an arm [s]."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ArmCell:
    """Arms at one table, with the same joints each.

    Arrays are float64 in the order of `commanded` [rad, m, per s]; measurements are in the order of
    `joints`.

    Attributes:
        robot: name of the robot in messages to the cameras.
        arms: names of the arms; "" for a single one.
        joints: all moving joints.
        commanded: joints that can be commanded, arm after arm.
        followed: for each of `joints`, the index of the commanded joint that it follows: itself, or
            the one that it mimics.
        grippers: indices of the gripper joints in `commanded`.
        start: start position: at home with open grippers.
        lower, upper: position limits; a gripper's are closed and open.
        velocity, acceleration: velocity and acceleration limits.
        force: motor limits, in the order of `joints` [Nm, N].
        lifted_m: height above its resting position at which a cube counts as lifted.
    """

    robot: str
    arms: tuple[str, ...] = ("",)
    joints: tuple[str, ...]
    commanded: tuple[str, ...]
    followed: tuple[int, ...]
    grippers: tuple[int, ...]
    start: F64
    lower: F64
    upper: F64
    velocity: F64
    acceleration: F64
    force: F64
    lifted_m: float = LIFTED_M

    @property
    def arm_joints(self) -> tuple[str, ...]:
        """The commanded joints without grippers."""
        named = enumerate(self.commanded)
        return tuple(name for number, name in named if number not in self.grippers)

    def opening(self, measured: F64) -> float | None:
        """Opening of the first gripper, 0 closed .. 1 open, from positions in the order of
        `joints`; None without a gripper.
        """
        if not self.grippers:
            return None
        gripper = self.grippers[0]
        closed, opened = self.lower[gripper], self.upper[gripper]
        share = (measured[self.followed.index(gripper)] - closed) / (opened - closed)
        return float(np.clip(share, 0.0, 1.0))


def carrying_arm(camera_mount: str, arms: Sequence[str]) -> int | None:
    """Index of the arm that carries a camera with this `mount`; None for one next to the table."""
    if camera_mount == "base":
        return None
    names = [f"{arm}/tcp" for arm in arms]
    return names.index(camera_mount) if camera_mount in names else 0
