"""Arrangement of arms at a table: the cell of one FR3 and that of two that face each other."""

from __future__ import annotations

from dataclasses import dataclass

from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT, MIMIC_FINGER_JOINT

MOVED = (*ARM_JOINTS, FINGER_JOINT)
"""Joints of one arm that can be commanded, in order."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Mount:
    """An arm and its mounting pose.

    Attributes:
        name: name of the arm; "" for a single one.
        x_m, yaw_rad: pose of its base on the table, in the base frame of the cell.
    """

    name: str = ""
    x_m: float = 0.0
    yaw_rad: float = 0.0

    @property
    def prefix(self) -> str:
        """Prefix of the names of its links and joints."""
        return f"{self.name}_" if self.name else ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Workcell:
    """Arms at one table; the base frame is that of the first arm's base.

    Attributes:
        robot: name of the robot that consists of these arms.
        mounts: the arms, in the order of all joint arrays of the simulation.
        table_size_m, table_centre_m: size and centre of the table's plate.
    """

    robot: str
    mounts: tuple[Mount, ...]
    table_size_m: tuple[float, float, float]
    table_centre_m: tuple[float, float, float]

    @property
    def joints(self) -> tuple[str, ...]:
        """All moving joints, in the order of all joint arrays: seven and two fingers for each
        arm.
        """
        own = (*MOVED, MIMIC_FINGER_JOINT)
        return tuple(f"{mount.prefix}{joint}" for mount in self.mounts for joint in own)

    @property
    def arm_joints(self) -> tuple[str, ...]:
        """Joints of the arms without fingers."""
        return tuple(f"{mount.prefix}{joint}" for mount in self.mounts for joint in ARM_JOINTS)

    @property
    def commanded(self) -> tuple[str, ...]:
        """Joints that can be commanded: seven and one finger for each arm."""
        return tuple(f"{mount.prefix}{joint}" for mount in self.mounts for joint in MOVED)


FR3 = Workcell(
    robot="fr3",
    mounts=(Mount(),),
    table_size_m=(1.30, 1.20, 0.05),
    table_centre_m=(0.35, 0.0, -0.025),
)
FACING_M = 1.15
"""Distance between the bases of two arms; each reaches the cubes, and a hand above the middle."""
PAIR = Workcell(
    robot="fr3-pair",
    mounts=(Mount(name="left"), Mount(name="right", x_m=FACING_M, yaw_rad=3.141592653589793)),
    table_size_m=(1.75, 1.20, 0.05),
    table_centre_m=(FACING_M / 2.0, 0.0, -0.025),
)
CELLS = {cell.robot: cell for cell in (FR3, PAIR)}
"""Cell by name of the robot."""
