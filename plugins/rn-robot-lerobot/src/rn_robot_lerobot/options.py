"""Options of the simulated SO-101."""

from __future__ import annotations

from pydantic import Field

from rn_robot_lerobot.scene import DEFAULT_COLOURS
from rn_simulation.arm_options import SimulatedArmOptions


class SimulatedSo101Options(SimulatedArmOptions):
    """Options of the driver `simulated`."""

    colours: tuple[str, ...] = Field(
        default=DEFAULT_COLOURS,
        description="One cube each: red, green, blue, yellow, orange, purple; at most four.",
        max_length=4,
    )
