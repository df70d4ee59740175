"""Scenes drawn from seeds, and positions in them."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence

from rn_eval.agents.task import AgentScene
from rn_robot_fr3.scene import random_cubes
from rn_simulation.cubes import RGBA_BY_COLOUR, Cube

ALL_COLOURS = tuple(RGBA_BY_COLOUR)
CLEAR_M = 0.04
"""Minimum difference between compared cubes, so that the answer does not depend on millimetres."""
_TRIES = 2000

Condition = Callable[[Mapping[str, Cube]], bool]


def draw(task: str, seed: int) -> random.Random:
    """Random numbers of a task for a seed, independent of the scene."""
    return random.Random(f"{task} {seed}")


def some_colours(chance: random.Random, least: int = 3, most: int = 5) -> tuple[str, ...]:
    """Draw different colours."""
    return tuple(chance.sample(ALL_COLOURS, chance.randint(least, most)))


def cubes_of(scene: AgentScene) -> dict[str, Cube]:
    """Initial cubes of a scene by colour."""
    return {cube.name: cube for cube in random_cubes(scene.seed, scene.colours)}


def find_seed(seed: int, colours: Sequence[str], condition: Condition = lambda cubes: True) -> int:
    """Seed of a scene that meets a condition; always the same one.

    Raises:
        ValueError: none of the tried seeds does.
    """
    for tried in range(_TRIES):
        scene = seed * _TRIES + tried
        if condition({cube.name: cube for cube in random_cubes(scene, colours)}):
            return scene
    raise ValueError(f"No scene of seed {seed} with {', '.join(colours)} meets the condition.")


def is_free(
    cubes: Mapping[str, Cube], moved: str, x_m: float, y_m: float, least_m: float = 0.105
) -> bool:
    """True if a cube may be put there: within reach, with room for the fingers."""
    inside = 0.36 <= x_m <= 0.64 and -0.34 <= y_m <= 0.34
    others = [cube for name, cube in cubes.items() if name != moved]
    return inside and all(math.hypot(c.x_m - x_m, c.y_m - y_m) >= least_m for c in others)


def clear_first(values: Mapping[str, float], clear_m: float = CLEAR_M) -> str:
    """The name with the clearly smallest value; "" if the difference is too small."""
    first, second = sorted(values, key=lambda name: values[name])[:2]
    return first if values[second] - values[first] >= clear_m else ""
