"""Cubes that nobody touches stay where they are, whatever the engine; stepped without waiting."""

from __future__ import annotations

import numpy as np
import pytest

from rn_robot_fr3.simulation import STEP_S, ArmSimulation

SETTLE_S = 2.0
CREEP_M = 0.2e-3


@pytest.mark.parametrize(
    "minutes",
    [
        # the fault moved a cube of this scene by 0.16 mm in 20 s
        pytest.param(1 / 6, id="10-s"),
        pytest.param(30.0, id="30-min", marks=[pytest.mark.slow, pytest.mark.timeout(1200)]),
    ],
)
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize("seed", [3])
def test_untouched_cubes_stay_where_they_are(engine: str, seed: int, minutes: float) -> None:
    with ArmSimulation(seed, engine=engine) as simulation:
        simulation.step(round(SETTLE_S / STEP_S))
        before = {name: np.array(cube.position_m) for name, cube in simulation.cubes().items()}
        turned = {name: np.array(cube.quaternion_xyzw) for name, cube in simulation.cubes().items()}
        simulation.step(round(60.0 * minutes / STEP_S))
        for name, cube in simulation.cubes().items():
            moved_m = float(np.linalg.norm(np.array(cube.position_m) - before[name]))
            assert moved_m < CREEP_M * min(1.0, minutes / 3.0), name
            cosine = abs(float(np.array(cube.quaternion_xyzw) @ turned[name]))
            assert 2.0 * np.arccos(min(1.0, cosine)) < 1e-3, name
