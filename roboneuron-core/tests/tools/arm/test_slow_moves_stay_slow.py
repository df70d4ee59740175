"""Moves by deltas: a yaw in degrees; one that was kept back goes on at the asked speed, and does
not catch up; an arm of few joints turns as it must.
"""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import pytest

from roboneuron import (
    InvalidInputError,
    Pose,
    StateError,
    matrix_from_rotvec,
    quaternion_from_matrix,
)
from roboneuron.tools.arm.ee_line import STEP_S, Order, steps_to_end
from roboneuron.tools.arm.ee_move import MoveEndEffector

MOST = (0.25, 1.0)


def test_a_yaw_is_given_in_degrees_or_radians() -> None:
    turned = MoveEndEffector(rz_deg=-90.0, dx_m=0.1).delta()
    assert turned == pytest.approx([0.1, 0.0, 0.0, 0.0, 0.0, -np.pi / 2])
    assert MoveEndEffector(rz_rad=-np.pi / 2, dx_m=0.1).delta() == pytest.approx(turned)
    with pytest.raises(InvalidInputError):
        MoveEndEffector(rz_deg=10.0, rz_rad=0.1).delta()


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("held_steps", [0, 10])
@pytest.mark.parametrize(("way_m", "way_rad"), [(0.2, 0.0), (0.2, 0.5), (0.0, 0.5), (0.05, 1.0)])
def test_no_step_is_faster_than_asked(
    share: float, held_steps: int, way_m: float, way_rad: float
) -> None:
    shortest_s = max(way_m / MOST[0], way_rad / MOST[1])
    order = Order(
        translation_m=np.array([0.0, way_m, 0.0]),
        rotation_rad=np.array([0.0, 0.0, way_rad]),
        gripper_open=None,
        duration_s=shortest_s / share,
    )
    place, turn, clock = np.zeros(3), np.zeros(3), count()
    steps: list[Any] = []

    def pose() -> Pose:
        matrix = matrix_from_rotvec(turn)
        return Pose(position_m=place.copy(), quaternion_xyzw=quaternion_from_matrix(matrix))

    made = steps_to_end(
        order, pose(), pose, lambda: next(clock) * STEP_S, lambda: "", speeds=MOST, longest_s=60.0
    )
    for number, (_, _, _, delta) in enumerate(made):
        if number >= held_steps:
            place, turn = place + delta[:3], turn + delta[3:]
            steps.append(delta)
    assert place == pytest.approx([0.0, way_m, 0.0], abs=0.003)
    most = np.max([[np.linalg.norm(d[:3]), np.linalg.norm(d[3:])] for d in steps], axis=0) / STEP_S
    assert most[0] <= way_m / order.duration_s * 1.02 + 1e-3
    assert most[1] <= way_rad / order.duration_s * 1.02 + 1e-3


@pytest.mark.parametrize("keeps_rotation", [True, False])
def test_an_arm_that_turns_as_it_goes_arrives_unless_its_rotation_is_asked_for(
    keeps_rotation: bool,
) -> None:
    order = Order(
        translation_m=np.array([0.1, 0.0, 0.0]),
        rotation_rad=np.zeros(3),
        gripper_open=None,
        duration_s=1.0,
        keeps_rotation=keeps_rotation,
    )
    place, clock = np.zeros(3), count()

    def pose() -> Pose:
        turned = matrix_from_rotvec(np.array([0.0, 3.0 * place[0], 0.0]))
        return Pose(position_m=place.copy(), quaternion_xyzw=quaternion_from_matrix(turned))

    made = steps_to_end(
        order, pose(), pose, lambda: next(clock) * STEP_S, lambda: "", speeds=MOST, longest_s=60.0
    )
    try:
        for _, _, _, delta in made:
            place = place + delta[:3]
    except StateError:
        assert keeps_rotation
    else:
        assert not keeps_rotation
        assert place == pytest.approx(order.translation_m, abs=0.003)
