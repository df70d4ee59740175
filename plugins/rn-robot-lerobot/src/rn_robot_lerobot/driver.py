"""The driver `simulated`."""

from __future__ import annotations

from rn_robot_lerobot.options import SimulatedSo101Options
from rn_robot_lerobot.simulation import So101Simulation
from rn_simulation.arm_driver import SimulatedArmDriver
from roboneuron import RobotProfile, Topics


class SimulatedSo101Driver(SimulatedArmDriver):
    """Drives the simulated SO-101."""

    def __init__(
        self, config: SimulatedSo101Options | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Store the arguments."""
        options = config or SimulatedSo101Options()
        simulation = So101Simulation(options.seed, colours=options.colours)
        super().__init__("SO-101", simulation, options, profile, topics)
