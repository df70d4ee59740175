"""Numbers of the original code (lerobot 0.6.1, VLASH's rule) for merging chunks and rolling states
forward.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rn_testing.chunk_merging import (
    AGGREGATIONS,
    aggregate,
    state_of_running_chunk,
    temporal_ensemble,
)
from roboneuron.contract import Observation, Pose
from roboneuron.modules.execution.roll_forward import roll_forward

GOLDEN = np.load(Path(__file__).parent / "data" / "chunk_execution.npz")
ROWS = 6


def golden(name: str) -> NDArray[Any]:
    return np.asarray(GOLDEN[name.replace("/", "|")])


def same_rotation(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Equal up to the sign, which a quaternion leaves open."""
    return bool(min(np.abs(first - second).max(), np.abs(first + second).max()) < 1e-12)


@pytest.mark.parametrize("case", range(4))
def test_the_state_is_rolled_forward_row_by_row(case: int) -> None:
    of = f"roll_delta/{case}"
    rows, opening = golden(f"{of}/committed_actions"), float(golden(f"{of}/gripper_open"))
    pose = Pose(
        position_m=golden(f"{of}/position_m"), quaternion_xyzw=golden(f"{of}/quaternion_xyzw")
    )
    measured = Observation(frames={}, instruction="go", ee_pose=pose, gripper_open=opening)
    for count in range(1, len(rows) + 1):
        after = roll_forward(measured, rows[:count])
        rolled = after.ee_pose
        assert rolled is not None
        np.testing.assert_allclose(
            rolled.position_m, golden(f"{of}/rolled_position_m")[count], atol=1e-12
        )
        assert same_rotation(rolled.quaternion_xyzw, golden(f"{of}/rolled_quaternion_xyzw")[count])
        assert after.gripper_open == pytest.approx(
            golden(f"{of}/rolled_gripper_open")[count], abs=1e-12
        )


@pytest.mark.parametrize("case", range(4))
def test_the_first_row_counts_with_the_share_that_is_left(case: int) -> None:
    of = f"roll_delta/{case}"
    pose = Pose(
        position_m=golden(f"{of}/position_m"), quaternion_xyzw=golden(f"{of}/quaternion_xyzw")
    )
    share = float(golden(f"{of}/done_share_of_first"))
    measured = Observation(frames={}, instruction="go", ee_pose=pose)
    rolled = roll_forward(measured, golden(f"{of}/committed_actions"), share).ee_pose
    assert rolled is not None
    np.testing.assert_allclose(
        rolled.position_m, golden(f"{of}/rolled_position_m_partial"), atol=1e-12
    )
    assert same_rotation(rolled.quaternion_xyzw, golden(f"{of}/rolled_quaternion_xyzw_partial"))


def test_absolute_actions_give_the_last_one_as_state() -> None:
    for i, overlap in enumerate(golden("roll_absolute/overlap")):
        start, state = state_of_running_chunk(
            golden("roll_absolute/chunk"), int(overlap), golden("roll_absolute/measured_state")
        )
        assert start == golden("roll_absolute/trigger_index")[i]
        np.testing.assert_array_equal(state, golden("roll_absolute/state_for_model")[i])


@pytest.mark.parametrize("decay", ["0.01", "0", "0.1", "-0.1"])
def test_temporal_ensembling_is_act_s(decay: str) -> None:
    chunks = golden("ensemble/chunks")
    for step in range(len(chunks)):
        rows = [chunks[made][step - made] for made in range(max(0, step - ROWS + 1), step + 1)]
        mean = temporal_ensemble(rows, float(decay))
        # they agree to 1e-7 among themselves, in float32
        for kind in ("online_lerobot", "offline"):
            np.testing.assert_allclose(mean, golden(f"ensemble/m{decay}/{kind}")[step], atol=1e-6)


@pytest.mark.parametrize(("every", "delay"), [(2, 1), (3, 2)])
def test_sparse_and_late_chunks_are_ensembled_by_rank(every: int, delay: int) -> None:
    chunks, name = golden("ensemble/chunks"), f"ensemble/sparse_every{every}_delay{delay}"
    for step in range(len(chunks)):
        made = [m for m in range(0, step + 1, every) if m + delay <= step and step - m < ROWS]
        assert len(made) == golden(f"{name}/count")[step]
        if made:
            mean = temporal_ensemble([chunks[m][step - m] for m in made])
            np.testing.assert_allclose(mean, golden(f"{name}/actions")[step], atol=1e-6)


@pytest.mark.parametrize("how", list(AGGREGATIONS))
def test_overlaps_are_aggregated_as_lerobot_does(how: str) -> None:
    def by_step(name: str) -> dict[int, Any]:
        return dict(
            zip(golden(f"aggregate/{name}_step").tolist(), golden(f"aggregate/{name}"), strict=True)
        )

    result = aggregate(
        by_step("old"), by_step("new"), int(golden("aggregate/latest_executed_step")), how
    )
    assert list(result) == golden("aggregate/result_step").tolist()
    np.testing.assert_allclose(
        np.stack(list(result.values())), golden(f"aggregate/{how}"), atol=1e-12
    )
