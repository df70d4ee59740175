"""Physics of the SO-101's cell, stepped explicitly, so that tests run faster than real time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rn_robot_lerobot.arm import GRIPPER_JOINT, JOINTS, SO101
from rn_robot_lerobot.cameras import cameras
from rn_robot_lerobot.scene import DEFAULT_COLOURS, LIFTED_M, random_cubes
from rn_simulation.arm_cell import ArmCell
from rn_simulation.arm_simulation import CellSimulation
from rn_simulation.arm_world import ArmWorld
from rn_simulation.cubes import Cube
from rn_simulation.mujoco_arm import MujocoArmWorld, MujocoCell, Servo

_COUNT = len(JOINTS)
_LOWER, _UPPER = np.transpose(SO101.ends_rad())
CELL = ArmCell(
    robot=SO101.name,
    joints=JOINTS,
    commanded=JOINTS,
    followed=tuple(range(_COUNT)),
    grippers=(JOINTS.index(GRIPPER_JOINT),),
    start=SO101.start_rad(),
    lower=_LOWER,
    upper=_UPPER,
    velocity=np.full(_COUNT, SO101.velocity_rad_s),
    acceleration=np.full(_COUNT, SO101.acceleration_rad_s2),
    force=np.array((*SO101.effort_nm, SO101.jaw_effort_nm)),
    lifted_m=LIFTED_M,
)
_SERVO = Servo(stiffness=60.0, damping=2.5, armature=0.01)
"""With these estimates the joint is within 2 mrad of its goal at rest."""


def build_world(cubes: Sequence[Cube]) -> ArmWorld:
    """The SO-101, its table and `cubes` in MuJoCo."""
    facts = MujocoCell(
        urdf=SO101.urdf(),
        tcp_links=(SO101.tcp_link,),
        servos=(_SERVO,) * _COUNT,
        friction=(1.5, 0.02, 0.0),
        table_size_m=(0.70, 0.80, 0.05),
        table_centre_m=(0.15, 0.0, -0.025),
        contact_spring=(0.004, 1.0),
        substeps=4,  # a cube of 10 g on contact springs needs 1 ms
        motors_carry_arm=False,
    )
    return MujocoArmWorld(CELL, facts, cubes)


class So101Simulation(CellSimulation):
    """A simulated SO-101 at a table with coloured cubes."""

    def __init__(self, seed: int = 0, *, colours: Sequence[str] = DEFAULT_COLOURS) -> None:
        """Choose the scene. Raises ConfigurationError for unknown colours or too many cubes."""
        super().__init__(
            CELL,
            seed=seed,
            scene=random_cubes(seed, colours),
            engine="mujoco",
            cameras=cameras(),
        )

    def build_world(self) -> ArmWorld:
        """See `CellSimulation`."""
        return build_world(self.scene)
