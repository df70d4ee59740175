"""The driver `simulated`."""

from __future__ import annotations

from rn_robot_fr3.cell import CELLS, FR3
from rn_robot_fr3.options import SimulatedFr3Options
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.arm_driver import SimulatedArmDriver
from rn_simulation.twin import CellTwin
from roboneuron import RobotProfile, Topics


class SimulatedFr3Driver(SimulatedArmDriver):
    """Drives one simulated FR3, or two with the pair's profile."""

    def __init__(
        self, config: SimulatedFr3Options | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Store the arguments."""
        options = config or SimulatedFr3Options()
        cell = CELLS.get(profile.name, FR3)

        def simulation(gui: bool) -> ArmSimulation:
            return ArmSimulation(
                options.seed,
                colours=options.colours,
                engine=options.engine,
                gui=gui,
                cell=cell,
            )

        super().__init__("FR3", simulation(options.gui), options, profile, topics)
        self._headless = simulation(gui=False)

    def twin(self) -> CellTwin:
        """Twin for simulated calls, without a window."""
        return CellTwin(self._headless)
