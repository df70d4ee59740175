"""The cameras of the simulated FR3s."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from rn_robot_fr3.cameras import cell_cameras
from rn_robot_fr3.cell import CELLS, FR3, PAIR, Workcell
from rn_robot_fr3.world import build_world
from rn_simulation.arm_cameras import SimulatedArmCameras
from rn_simulation.arm_world import ArmWorld
from rn_simulation.cubes import Cube
from rn_simulation.pinhole import PinholeCamera
from rn_simulation.scene_state import SceneState


class SimulatedFr3Cameras(SimulatedArmCameras):
    """Front and wrist camera of the simulated FR3.

    Attributes:
        cell: cell of the cameras.
    """

    cell: ClassVar[Workcell] = FR3
    robot = FR3.robot

    def known(self) -> Sequence[PinholeCamera]:
        """See `StateCameras`."""
        return cell_cameras(self.cell)

    def joint_counts(self) -> Mapping[str, int]:
        """See `SimulatedArmCameras`."""
        return {name: len(cell.joints) for name, cell in CELLS.items()}

    def build(self, state: SceneState, cubes: Sequence[Cube]) -> ArmWorld:
        """See `SimulatedArmCameras`."""
        return build_world(state.engine, cubes, cell=CELLS[state.robot])


class SimulatedPairCameras(SimulatedFr3Cameras):
    """The cameras of two simulated FR3s."""

    cell: ClassVar[Workcell] = PAIR
    robot = PAIR.robot
