"""User options of the simulated driver."""

from __future__ import annotations

from pydantic import Field

from rn_simulation.arm_options import SimulatedArmOptions
from rn_simulation.engine import EngineChoice


class SimulatedFr3Options(SimulatedArmOptions):
    """Options of the driver `simulated`."""

    engine: EngineChoice = Field(
        default="auto",
        description="Physics engine; auto is PyBullet where it is installed, otherwise MuJoCo.",
    )
    gui: bool = Field(
        default=False, description="Show PyBullet's window; needs a display. MuJoCo shows none."
    )
