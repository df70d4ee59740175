"""Which cubes lie on the SO-101's table."""

from __future__ import annotations

from collections.abc import Sequence

from rn_simulation.cubes import Cube, CubeRegion, random_cubes_in

DEFAULT_COLOURS = ("red", "green", "blue")
REGION = CubeRegion(x_m=(0.15, 0.235), y_m=(-0.11, 0.11), spacing_m=0.07, edge_m=(0.022, 0.026))
"""Where the gripper reaches pointing straight down, with room for its open jaw."""
LIFTED_M = 0.04
"""A cube counts as lifted from this height on: pointing down, the gripper comes up to 8 cm."""


def random_cubes(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> tuple[Cube, ...]:
    """One cube per colour; the same seed and colours give the same ones.

    Raises:
        ConfigurationError: unknown colours, one twice, or more than find room; a negative seed.
    """
    return random_cubes_in(REGION, seed, colours)
