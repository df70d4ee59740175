"""The world in MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence

from rn_robot_fr3.cell import FR3, Workcell
from rn_robot_fr3.description import TCP_LINK, cell_urdf
from rn_robot_fr3.scene import FINGER_FRICTION
from rn_robot_fr3.simulated_cell import arm_cell
from rn_simulation.cubes import Cube
from rn_simulation.mujoco_arm import MujocoArmWorld, MujocoCell, Servo
from roboneuron import ConfigurationError

_SERVOS = (
    *[Servo(stiffness=20000.0, damping=600.0, armature=0.1)] * 4,
    *[Servo(stiffness=5000.0, damping=120.0, armature=0.1)] * 3,
    *[Servo(stiffness=10000.0, damping=200.0, armature=0.3)] * 2,
)
"""Motors of the seven joints and two fingers; the inertias are estimates."""
_CONTACT_SPRING = (0.005, 1.0)
"""Stiff enough that the measured width of a grasped cube is within 1 mm."""


def mujoco_world(
    cubes: Sequence[Cube], *, gui: bool = False, cell: Workcell = FR3
) -> MujocoArmWorld:
    """Build the world. Raises ConfigurationError if a window is requested."""
    if gui:
        raise ConfigurationError(
            "The simulation was asked for a window, which it has with PyBullet only.",
            hint="Set gui = false, or use PyBullet on Python 3.11: pip compiles it on newer "
            "versions.",
        )
    facts = MujocoCell(
        urdf=cell_urdf(cell),
        tcp_links=tuple(f"{mount.prefix}{TCP_LINK}" for mount in cell.mounts),
        servos=_SERVOS * len(cell.mounts),
        friction=FINGER_FRICTION,
        table_size_m=cell.table_size_m,
        table_centre_m=cell.table_centre_m,
        contact_spring=_CONTACT_SPRING,
        substeps=2,
        motors_carry_arm=True,
    )
    return MujocoArmWorld(arm_cell(cell), facts, cubes)
