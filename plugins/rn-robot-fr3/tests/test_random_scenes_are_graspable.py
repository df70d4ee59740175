"""Scenes are repeatable, free of contact, reachable, and refused if impossible."""

from __future__ import annotations

import numpy as np
import pytest

from rn_robot_fr3.scene import EDGE_M, REGION_X_M, REGION_Y_M, SPACING_M, random_cubes
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.cubes import RGBA_BY_COLOUR
from rn_simulation.engine import Engine
from roboneuron.errors import ConfigurationError


def test_a_seed_gives_the_same_scene_and_another_seed_another() -> None:
    assert random_cubes(4) == random_cubes(4)
    assert random_cubes(4) != random_cubes(5)


@pytest.mark.parametrize("colours", [("red", "green", "blue", "yellow"), tuple(RGBA_BY_COLOUR)])
def test_cubes_lie_in_reach_with_room_for_a_finger_between_them(colours: tuple[str, ...]) -> None:
    for seed in range(100):
        cubes = random_cubes(seed, colours)
        centres = np.array([(cube.x_m, cube.y_m) for cube in cubes])
        distance = np.linalg.norm(centres[:, None] - centres, axis=2) + np.eye(len(cubes))
        assert distance.min() >= SPACING_M
        assert (centres >= [REGION_X_M[0], REGION_Y_M[0]]).all()
        assert (centres <= [REGION_X_M[1], REGION_Y_M[1]]).all()
        assert all(EDGE_M[0] <= cube.edge_m <= EDGE_M[1] for cube in cubes)


def test_cubes_stay_where_the_scene_puts_them(engine: Engine) -> None:
    with ArmSimulation(11, engine=engine) as simulation:
        before = simulation.cubes()
        simulation.step(240)
        for name, cube in simulation.cubes().items():
            # The solver lets a box sink into the table by a fraction of a millimetre.
            np.testing.assert_allclose(cube.position_m, before[name].position_m, atol=5e-4)
            assert cube.held_s == 0.0


@pytest.mark.parametrize(
    ("seed", "colours", "named"),
    [
        (0, ("red", "mauve"), "mauve"),
        (0, ("red", "red"), "only once"),
        (0, (), "at least one"),
        (-1, ("red",), "-1"),
    ],
)
def test_an_impossible_scene_is_refused_by_name(
    seed: int, colours: tuple[str, ...], named: str
) -> None:
    with pytest.raises(ConfigurationError, match=named):
        random_cubes(seed, colours)
