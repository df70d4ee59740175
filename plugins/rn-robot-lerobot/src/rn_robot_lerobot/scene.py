"""Cubes on the SO-101's table."""

from __future__ import annotations

from collections.abc import Sequence

from rn_simulation.cubes import Cube, CubeRegion, random_cubes_in

DEFAULT_COLOURS = ("red", "green", "blue")
REGION = CubeRegion(x_m=(0.15, 0.235), y_m=(-0.11, 0.11), spacing_m=0.07, edge_m=(0.022, 0.026))
"""Region that the gripper reaches pointing straight down, with room for its open jaw."""
LIFTED_M = 0.04
"""Height at which a cube counts as lifted; pointing down, the gripper reaches 8 cm."""


def random_cubes(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> tuple[Cube, ...]:
    """Place one cube per colour; the same seed and colours give the same cubes.

    Raises:
        ConfigurationError: unknown or repeated colours, too many for the region, or a negative
            seed.
    """
    return random_cubes_in(REGION, seed, colours)
