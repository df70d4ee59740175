"""The motions of examples/cube_leader.py in the simulation, without ROS."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_policy_cubes.teacher import yaw_of
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.scene import REGION_X_M, REGION_Y_M
from rn_robot_fr3.simulation import JOINTS, ArmSimulation
from roboneuron import matrix_from_quaternion

LEADER = Path(__file__).parents[1] / "examples" / "cube_leader.py"
TICKS = 38
"""Simulation ticks per row, 0.16 s."""
RESET_ROWS = 62
"""Rows within the 10 s that `lerobot-record` leaves between two episodes."""


@pytest.fixture(scope="module")
def leader() -> dict[str, Any]:
    return runpy.run_path(str(LEADER))


def joints_of(simulation: ArmSimulation) -> dict[str, float]:
    return dict(zip(JOINTS, simulation.joint_positions().tolist(), strict=True))


def play(simulation: ArmSimulation, leader: dict[str, Any], rows: np.ndarray) -> None:
    names = leader["LeaderArm"](joints_of(simulation)).names
    for row in rows:
        simulation.set_target(names, row, leader["ROW_S"])
        simulation.step(TICKS)


def test_it_picks_a_cube_up_and_puts_it_within_reach_again_and_again(
    leader: dict[str, Any],
) -> None:
    random = np.random.default_rng(0)
    places = []
    with ArmSimulation(5, colours=("red",)) as simulation:
        for _ in range(3):
            found = simulation.cubes()["red"]
            cube = leader["CubePlace"](
                position_m=np.array(found.position_m),
                yaw_rad=yaw_of(matrix_from_quaternion(np.array(found.quaternion_xyzw))),
                edge_m=found.edge_m,
            )
            places.append(cube.position_m[:2])
            rows = leader["demonstrate"](joints_of(simulation), cube, random)
            # within control's limits for a row: 0.1 m is about 0.17 rad, and the last joint only
            # turns the hand, by at most 0.5 rad
            steps = np.abs(np.diff(rows[:, :7], axis=0))
            assert steps[:, :6].max() < 0.2
            assert steps[:, 6].max() < 0.5
            play(simulation, leader, rows)
            assert simulation.cubes()["red"].lifted_m > leader["LIFTED_M"]
            back = leader["put_elsewhere"](joints_of(simulation), random)
            assert len(back) < RESET_ROWS
            play(simulation, leader, back)
            simulation.step(TICKS)
            x_m, y_m, z_m = simulation.cubes()["red"].position_m
            assert REGION_X_M[0] - 0.02 < x_m < REGION_X_M[1] + 0.02
            assert REGION_Y_M[0] - 0.02 < y_m < REGION_Y_M[1] + 0.02
            assert z_m < 0.03
            np.testing.assert_allclose(simulation.joint_positions()[:7], HOME_RAD, atol=0.02)
    assert min(np.linalg.norm(np.diff(places, axis=0), axis=1)) > 0.02
