"""Which cubes lie where: a scene is data, drawn from a seed, the same on every machine."""

from __future__ import annotations

from collections.abc import Sequence

from rn_simulation.cubes import DEFAULT_COLOURS, Cube, CubeRegion, random_cubes_in

REGION_X_M = (0.40, 0.62)
REGION_Y_M = (-0.24, 0.24)
"""Where cube centres may lie: the gripper reaches every point of it pointing straight down."""
SPACING_M = 0.115
"""Least distance between two centres: room for an open finger (66 mm from the middle) beside a
cube's corner.
"""
EDGE_M = (0.040, 0.048)
"""Cube edges: the diagonal of the largest still passes the open gripper (80 mm)."""
FINGER_FRICTION = (1.2, 0.02, 0.0)
"""Sliding, spinning and rolling (the last two in m)."""


def random_cubes(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> tuple[Cube, ...]:
    """One cube per colour, in random places that do not touch and leave room for the gripper.

    Args:
        seed: the same seed and colours give the same cubes.
        colours: keys of `RGBA_BY_COLOUR`.

    Raises:
        ConfigurationError: unknown colours, or one twice; or a negative seed.
    """
    region = CubeRegion(x_m=REGION_X_M, y_m=REGION_Y_M, spacing_m=SPACING_M, edge_m=EDGE_M)
    return random_cubes_in(region, seed, colours)
