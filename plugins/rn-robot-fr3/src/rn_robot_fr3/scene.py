"""Cubes of a scene: data, computed from a seed, identical on every machine."""

from __future__ import annotations

from collections.abc import Sequence

from rn_simulation.cubes import DEFAULT_COLOURS, Cube, CubeRegion, random_cubes_in

REGION_X_M = (0.40, 0.62)
REGION_Y_M = (-0.24, 0.24)
"""Range of cube centres, which the gripper reaches pointing straight down."""
SPACING_M = 0.115
"""Minimum distance between two centres: room for an open finger (66 mm from the middle) next to a
cube's corner.
"""
EDGE_M = (0.040, 0.048)
"""Cube edges; the diagonal of the largest still fits into the open gripper (80 mm)."""
FINGER_FRICTION = (1.2, 0.02, 0.0)
"""Sliding, spinning and rolling (the last two in m)."""


def random_cubes(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> tuple[Cube, ...]:
    """Place one cube per colour at random positions, without contact and with room for the gripper.

    Args:
        seed: the same seed and colours give the same cubes.
        colours: keys of `RGBA_BY_COLOUR`.

    Raises:
        ConfigurationError: unknown or repeated colours, or a negative seed.
    """
    region = CubeRegion(x_m=REGION_X_M, y_m=REGION_Y_M, spacing_m=SPACING_M, edge_m=EDGE_M)
    return random_cubes_in(region, seed, colours)
