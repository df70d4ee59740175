"""Physics of the FR3 cell, stepped explicitly, so that tests and benchmarks run faster than real
time.
"""

from __future__ import annotations

from collections.abc import Sequence

from rn_robot_fr3.cameras import cell_cameras
from rn_robot_fr3.cell import FR3, MOVED, Workcell
from rn_robot_fr3.scene import random_cubes
from rn_robot_fr3.simulated_cell import arm_cell
from rn_robot_fr3.world import JOINTS, build_world
from rn_simulation.arm_cell import STEP_S
from rn_simulation.arm_simulation import CellSimulation
from rn_simulation.arm_world import ArmWorld
from rn_simulation.cubes import DEFAULT_COLOURS
from rn_simulation.engine import EngineChoice, choose_engine
from rn_simulation.pinhole import PinholeCamera

COMMANDED = MOVED
"""Joints of one arm that can be commanded."""


class ArmSimulation(CellSimulation):
    """Simulated FR3s at a table with coloured cubes; by default one."""

    def __init__(
        self,
        seed: int = 0,
        *,
        colours: Sequence[str] = DEFAULT_COLOURS,
        engine: EngineChoice = "auto",
        gui: bool = False,
        cell: Workcell = FR3,
        cameras: Sequence[PinholeCamera] | None = None,
    ) -> None:
        """Choose scene and engine; `cameras` default to those of the cell.

        Raises:
            ConfigurationError: unknown colours, too many cubes, or the engine is not installed.
        """
        self.cell, self._gui = cell, gui
        super().__init__(
            arm_cell(cell),
            seed=seed,
            scene=random_cubes(seed, colours),
            engine=choose_engine(engine),
            cameras=cell_cameras(cell) if cameras is None else cameras,
        )

    def build_world(self) -> ArmWorld:
        """See `CellSimulation`. Raises ConfigurationError if a window is requested without a
        display.
        """
        return build_world(self.engine, self.scene, gui=self._gui, cell=self.cell)


__all__ = ["COMMANDED", "JOINTS", "STEP_S", "ArmSimulation"]
