"""A simulated arm without a gripper has no opening."""

from __future__ import annotations

import numpy as np
import pytest

from rn_simulation.arm_cell import ArmCell


@pytest.mark.parametrize(("grippers", "opening"), [((), None), ((1,), 0.25)])
def test_the_opening_is_that_of_the_first_gripper_if_there_is_one(
    grippers: tuple[int, ...], opening: float | None
) -> None:
    bounds = np.ones(2)
    cell = ArmCell(
        robot="toy",
        joints=("a", "b"),
        commanded=("a", "b"),
        followed=(0, 1),
        grippers=grippers,
        start=np.zeros(2),
        lower=np.zeros(2),
        upper=bounds,
        velocity=bounds,
        acceleration=bounds,
        force=bounds,
    )
    assert cell.opening(np.array([0.9, 0.25])) == opening
    assert cell.arm_joints == ("a", "b")[: 2 - len(grippers)]
