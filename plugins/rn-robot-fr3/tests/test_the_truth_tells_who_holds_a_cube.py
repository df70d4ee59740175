"""Ground truth of several arms: which one holds a lifted cube, and how long ago it was handed
over.
"""

from __future__ import annotations

import numpy as np
import pytest

from rn_simulation.cubes import Cube, RawPose
from rn_simulation.ground_truth import CubeState, LiftClock

CUBE = Cube(name="red", edge_m=0.04, x_m=0.5, y_m=0.0, yaw_rad=0.0)
ON_IT, AWAY, NEAR = np.array([0.5, 0.0, 0.4]), np.array([0.5, 0.5, 0.4]), np.array([0.5, 0.06, 0.4])
Places = tuple[float, np.ndarray, np.ndarray]  # type: ignore[type-arg]


def _pose(z_m: float) -> dict[str, RawPose]:
    return {"red": ((0.5, 0.0, z_m), (0.0, 0.0, 0.0, 1.0))}


def _after(*steps: Places) -> CubeState:
    """State after one second of each: height of the cube, TCP of the left and the right arm."""
    clock = LiftClock([CUBE], ["left", "right"])
    for second, (z_m, left, right) in enumerate(steps):
        clock.observe(float(second), _pose(z_m), [left, right])
    return clock.states(_pose(steps[-1][0]))["red"]


def test_a_cube_on_the_table_is_held_by_none() -> None:
    state = _after((0.02, ON_IT, AWAY))
    assert (state.holders, state.handed_over_s) == ((), 0.0)


def test_a_cube_that_one_arm_lifts_is_not_handed_over() -> None:
    state = _after((0.4, ON_IT, AWAY), (0.4, ON_IT, AWAY))
    assert (state.holders, state.held_s, state.handed_over_s) == (("left",), 1.0, 0.0)


def test_time_counts_from_when_the_other_arm_has_it_alone() -> None:
    state = _after((0.4, ON_IT, AWAY), (0.4, ON_IT, ON_IT), (0.4, AWAY, ON_IT), (0.4, AWAY, ON_IT))
    assert (state.holders, state.held_s, state.handed_over_s) == (("right",), 3.0, 1.0)


@pytest.mark.parametrize("last", [(0.4, NEAR, ON_IT), (0.02, AWAY, ON_IT), (0.4, AWAY, AWAY)])
def test_a_cube_that_is_not_held_alone_or_was_put_down_is_not(last: Places) -> None:
    assert _after((0.4, ON_IT, AWAY), (0.4, AWAY, ON_IT), last).handed_over_s == 0.0


def test_a_cube_that_was_put_down_between_is_lifted_anew() -> None:
    state = _after((0.4, ON_IT, AWAY), (0.02, AWAY, AWAY), (0.4, AWAY, ON_IT), (0.4, AWAY, ON_IT))
    assert (state.holders, state.handed_over_s) == (("right",), 0.0)
