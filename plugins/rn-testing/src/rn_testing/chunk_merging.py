"""Methods of other systems for merging chunks that overlap in time; for comparisons only, not used
by RoboNeuron's modules.

Rows are float64 or float32 (..., D); step numbers count from the start of the episode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.floating]
AGGREGATIONS: Mapping[str, tuple[float, float]] = {
    "weighted_average": (0.3, 0.7),
    "latest_only": (0.0, 1.0),
    "average": (0.5, 0.5),
    "conservative": (0.7, 0.3),
}
"""Weights of the queued and of the new row of LeRobot's asynchronous client (lerobot 0.6.1)."""


def temporal_ensemble(predictions: Sequence[Rows], decay: float = 0.01) -> Rows:
    """Return the mean of several predictions for one step.

    Args:
        predictions: (D,) each, oldest first, N >= 1.
        decay: prediction k (0 is the oldest) has the weight exp(-decay k); positive values favour
            old predictions.

    Source: ACT, arXiv 2304.13705, algorithm 2.
    """
    weights = np.exp(-decay * np.arange(len(predictions)))
    mean: Rows = np.einsum("k,kd->d", weights / weights.sum(), np.stack(list(predictions)))
    return mean


def aggregate(
    queued: Mapping[int, Rows],
    new: Mapping[int, Rows],
    latest_executed_step: int,
    how: str = "weighted_average",
) -> dict[int, Rows]:
    """Return the queue after a new chunk, by time step.

    Args:
        queued, new: row (D,) by step.
        latest_executed_step: rows for this and earlier steps are dropped.
        how: key of AGGREGATIONS. Gripper channels are averaged too, which is bad for a real
            gripper.

    Source: lerobot 0.6.1, async_inference.
    """
    old_weight, new_weight = AGGREGATIONS[how]
    return {
        step: old_weight * queued[step] + new_weight * row if step in queued else row
        for step, row in sorted(new.items())
        if step > latest_executed_step
    }


def state_of_running_chunk(chunk: Rows, overlap_rows: int, measured: Rows) -> tuple[int, Rows]:
    """Return when a policy of absolute actions starts its next inference, and the state for it.

    Args:
        chunk: (N, D) absolute actions being executed.
        overlap_rows: rows before the end at which inference starts; 0 for the end.
        measured: (D,) state, used if no chunk is executed.

    Returns:
        Index of the row at which inference starts, and the state (D,): the chunk's last action.

    Source: VLASH, arXiv 2512.01031.
    """
    if not len(chunk):
        return 0, measured
    return len(chunk) - overlap_rows, chunk[-1]
