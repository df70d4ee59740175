"""A simulated arm without a gripper has no opening; the twin of one whose gripper is not measured
holds it where the cell starts.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_simulation.arm_cell import ArmCell
from rn_simulation.twin import CellTwin
from roboneuron import JointSample
from roboneuron.errors import InvalidInputError


def cell_with(grippers: tuple[int, ...]) -> ArmCell:
    bounds = np.ones(2)
    return ArmCell(
        robot="toy",
        joints=("a", "b"),
        commanded=("a", "b"),
        followed=(0, 1),
        grippers=grippers,
        start=np.array([0.0, 0.5]),
        lower=np.zeros(2),
        upper=bounds,
        velocity=bounds,
        acceleration=bounds,
        force=bounds,
    )


@pytest.mark.parametrize(("grippers", "opening"), [((), None), ((1,), 0.25)])
def test_the_opening_is_that_of_the_first_gripper_if_there_is_one(
    grippers: tuple[int, ...], opening: float | None
) -> None:
    cell = cell_with(grippers)
    assert cell.opening(np.array([0.9, 0.25])) == opening
    assert cell.arm_joints == ("a", "b")[: 2 - len(grippers)]


def placed(grippers: tuple[int, ...], names: tuple[str, ...]) -> list[float]:
    """Where the twin begins, whose measured joints are at 0.9."""
    found: list[float] = []
    simulation: Any = SimpleNamespace(
        arm_cell=cell_with(grippers),
        open=lambda: None,
        place=lambda positions, poses: found.extend(positions.tolist()),
    )
    CellTwin(simulation).open(JointSample(names=names, position=np.full(len(names), 0.9)))
    return found


def test_a_gripper_that_is_not_measured_begins_where_the_cell_starts() -> None:
    assert placed((1,), ("a",)) == [0.9, 0.5]
    assert placed((1,), ("a", "b")) == [0.9, 0.9]


@pytest.mark.parametrize(("grippers", "names"), [((), ("a",)), ((1,), ("b",))])
def test_a_joint_of_the_arm_has_to_be_measured(
    grippers: tuple[int, ...], names: tuple[str, ...]
) -> None:
    with pytest.raises(InvalidInputError, match="not measured"):
        placed(grippers, names)
