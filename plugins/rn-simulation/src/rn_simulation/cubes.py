"""Coloured cubes on a table: a scene is data, computed from a seed, identical on every machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron import ConfigurationError

RawPose = tuple[Sequence[float], Sequence[float]]
"""Position [m] and quaternion (x y z w) in the base frame."""

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

WOOD_KG_M3 = 700.0
"""Density of the cubes."""
CUBE_FRICTION = (1.0, 0.005, 0.0005)
"""Sliding, spinning and rolling (the last two in m)."""
TABLE_RGBA = (0.80, 0.76, 0.70, 1.0)
TABLE_FRICTION = 0.8
"""Sliding."""

_ATTEMPTS = 2000


@dataclass(frozen=True, kw_only=True, slots=True)
class Cube:
    """A cube at the start.

    Attributes:
        name: its colour, a key of `RGBA_BY_COLOUR`.
        edge_m: edge length.
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
        ConfigurationError: no colour, an unknown one, or a repeated one.
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


@dataclass(frozen=True, kw_only=True, slots=True)
class CubeRegion:
    """Region and size range of random cubes.

    Attributes:
        x_m, y_m: lowest and highest coordinate of centres, base frame.
        spacing_m: minimum distance between two centres.
        edge_m: shortest and longest edge.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    spacing_m: float
    edge_m: tuple[float, float]


def random_cubes_in(region: CubeRegion, seed: int, colours: Sequence[str]) -> tuple[Cube, ...]:
    """Place one cube per colour at random positions, with room for the gripper.

    Args:
        region: region of the cubes.
        seed: the same seed and colours give the same cubes.
        colours: keys of `RGBA_BY_COLOUR`.

    Raises:
        ConfigurationError: as `check_colours`, a negative seed, or not enough room.
    """
    names = check_colours(colours)
    if seed < 0:
        raise ConfigurationError(f"Scene seed is {seed}, expected an integer >= 0.")
    random = np.random.default_rng(seed)
    for _ in range(_ATTEMPTS):
        x = random.uniform(*region.x_m, len(names))
        y = random.uniform(*region.y_m, len(names))
        distance = np.hypot(x[:, None] - x, y[:, None] - y) + np.eye(len(names))
        if distance.min() >= region.spacing_m:
            break
    else:
        raise ConfigurationError(
            f"There is no space for {len(names)} cubes {region.spacing_m} m apart; use fewer."
        )
    edge, yaw = (
        random.uniform(*region.edge_m, len(names)),
        random.uniform(-math.pi / 4, math.pi / 4, len(names)),
    )
    return tuple(
        Cube(name=n, edge_m=float(e), x_m=float(a), y_m=float(b), yaw_rad=float(c))
        for n, e, a, b, c in zip(names, edge, x, y, yaw, strict=True)
    )
