"""Which cubes lie where, and what they and the table are made of: a scene is data, drawn from a
seed, the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron import ConfigurationError

RGBA_BY_COLOUR: dict[str, tuple[float, float, float, float]] = {
    "red": (0.84, 0.10, 0.10, 1.0),
    "green": (0.10, 0.62, 0.20, 1.0),
    "blue": (0.08, 0.26, 0.84, 1.0),
    "yellow": (0.96, 0.80, 0.08, 1.0),
    "orange": (0.95, 0.45, 0.05, 1.0),
    "purple": (0.50, 0.14, 0.66, 1.0),
}
"""Cube colours by name; no two share a hue."""
DEFAULT_COLOURS = ("red", "green", "blue", "yellow")

REGION_X_M = (0.40, 0.62)
REGION_Y_M = (-0.24, 0.24)
"""Where cube centres may lie: the gripper reaches every point of it pointing straight down."""
SPACING_M = 0.115
"""Least distance between two centres: room for an open finger (66 mm from the middle) beside a
cube's corner.
"""
EDGE_M = (0.040, 0.048)
"""Cube edges: the diagonal of the largest still passes the open gripper (80 mm)."""
RawPose = tuple[Sequence[float], Sequence[float]]
"""Position [m] and quaternion (x y z w) in the base frame."""

WOOD_KG_M3 = 700.0
TABLE_RGBA = (0.80, 0.76, 0.70, 1.0)
TABLE_FRICTION = 0.8
"""Sliding friction; the other coefficients are sliding, spinning and rolling (spinning and rolling
in m).
"""
FINGER_FRICTION = (1.2, 0.02, 0.0)
CUBE_FRICTION = (1.0, 0.005, 0.0005)
_ATTEMPTS = 2000


@dataclass(frozen=True, kw_only=True, slots=True)
class Cube:
    """A cube as it lies at the start.

    Attributes:
        name: its colour, a key of `RGBA_BY_COLOUR`.
        edge_m: length of its edges.
        x_m, y_m: centre on the table, base frame.
        yaw_rad: rotation about the vertical.
    """

    name: str
    edge_m: float
    x_m: float
    y_m: float
    yaw_rad: float


def check_colours(colours: Sequence[str]) -> tuple[str, ...]:
    """Return `colours` as a tuple.

    Raises:
        ConfigurationError: none, an unknown one, or one twice.
    """
    known = ", ".join(RGBA_BY_COLOUR)
    unknown = [colour for colour in colours if colour not in RGBA_BY_COLOUR]
    if unknown:
        raise ConfigurationError(
            f"Cube colour {unknown[0]!r} is not known, expected some of {known}."
        )
    if not colours or len(set(colours)) != len(colours):
        raise ConfigurationError(
            f"Cube colours are {list(colours)}, expected at least one and each only once."
        )
    return tuple(colours)


def random_cubes(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> tuple[Cube, ...]:
    """One cube per colour, in random places that do not touch and leave room for the gripper.

    Args:
        seed: the same seed and colours give the same cubes.
        colours: keys of `RGBA_BY_COLOUR`.

    Raises:
        ConfigurationError: as `check_colours`, or a negative seed.
    """
    names = check_colours(colours)
    if seed < 0:
        raise ConfigurationError(f"Scene seed is {seed}, expected an integer >= 0.")
    random = np.random.default_rng(seed)
    for _ in range(_ATTEMPTS):
        x = random.uniform(*REGION_X_M, len(names))
        y = random.uniform(*REGION_Y_M, len(names))
        distance = np.hypot(x[:, None] - x, y[:, None] - y) + np.eye(len(names))
        if distance.min() >= SPACING_M:
            break
    else:
        raise ConfigurationError(
            f"{len(names)} cubes find no room {SPACING_M} m apart; ask for fewer."
        )
    edge, yaw = (
        random.uniform(*EDGE_M, len(names)),
        random.uniform(-math.pi / 4, math.pi / 4, len(names)),
    )
    return tuple(
        Cube(name=n, edge_m=float(e), x_m=float(a), y_m=float(b), yaw_rad=float(c))
        for n, e, a, b, c in zip(names, edge, x, y, yaw, strict=True)
    )
