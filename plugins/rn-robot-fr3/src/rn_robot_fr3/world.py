"""The simulated world of the FR3s; PyBullet and MuJoCo build the same one."""

from __future__ import annotations

from collections.abc import Sequence

from rn_robot_fr3.cell import FR3, Workcell
from rn_simulation.arm_world import ArmWorld
from rn_simulation.cubes import Cube
from rn_simulation.engine import Engine

JOINTS = FR3.joints
"""All moving joints of one arm, in the order of all joint arrays of its simulation."""


def build_world(
    engine: Engine, cubes: Sequence[Cube], *, gui: bool = False, cell: Workcell = FR3
) -> ArmWorld:
    """Build a world with the arms of `cell` and `cubes` in `engine`.

    Raises:
        ConfigurationError: a window is requested without a display, or the engine has none.
    """
    if engine == "mujoco":
        from rn_robot_fr3.mujoco_world import mujoco_world  # heavy, and perhaps not installed

        return mujoco_world(cubes, gui=gui, cell=cell)
    from rn_robot_fr3.pybullet_world import PybulletArmWorld  # likewise

    return PybulletArmWorld(cubes, gui=gui, cell=cell)
