"""Real-time chunking: a new chunk continues the rows that are executed while it is computed.

Source: arXiv 2506.07339 and real-time-chunking-kinetix (guided), arXiv 2512.05964 (training time),
lerobot 0.6.1 (names and defaults). Flow time runs from 1 (noise) to 0 (actions), as in pi0; tau = 1
- t.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_vla.normalisation import Values

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Schedule = Literal["linear", "exp", "ones", "zeros"]
Jacobian = Literal["identity", "full"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RunningChunk:
    """The backend's own form of a chunk (`ActionChunk.context`), uncut and unclipped.

    Attributes:
        normalized: float32 (H, A), output of the network.
        state: (n,), measured state used for it, in the training data's units.
    """

    normalized: F32
    state: Values


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Prefix:
    """The rows that the network continues.

    Attributes:
        rows: float32 (N, W <= A), normalised: rows not yet executed at the capture, oldest first.
        committed: number of rows that will be executed in any case.
        horizon: number of guided rows; None for all of them.
        schedule: decrease of the weights after the committed rows.
        max_weight: largest guidance weight, that of the first step.
        jacobian: "identity" as in LeRobot, "full" as in the paper (one backward pass for each
            step).
        trained: the checkpoint was trained on clean prefixes, which are then inserted instead of
            guided towards.
    """

    rows: F32
    committed: int
    horizon: int | None = None
    schedule: Schedule = "linear"
    max_weight: float = 10.0
    jacobian: Jacobian = "identity"
    trained: bool = False


def prefix_weights(committed: int, end: int, total: int, schedule: Schedule) -> F64:
    """Weight of each row of a chunk, float64 (total,), 0 .. 1.

    Args:
        committed: number of first rows with weight 1.
        end: first row with weight 0; at most the length of the left-over.
        total: number of rows of a chunk.
        schedule: weights between them: "linear" (end - i) / (end - committed + 1), "exp" w (e^w -
            1) / (e - 1) of it, "ones", "zeros".
    """
    start = min(committed, end)
    index = np.arange(total)
    if schedule == "ones":
        return (index < end).astype(np.float64)
    weights = (index < start).astype(np.float64)
    if schedule == "zeros":
        return weights
    ramp = (end - index) / (end - start + 1.0)
    if schedule == "exp":
        ramp = ramp * np.expm1(ramp) / np.expm1(1.0)
    between = (index >= start) & (index < end)
    weights[between] = ramp[between]
    return weights


def guidance_weights(times: Sequence[float], max_weight: float) -> tuple[float, ...]:
    """Weight of the guidance at each Euler step: (tau^2 + (1-tau)^2) / (tau (1-tau)), clipped at
    `max_weight`.
    """
    weights = []
    for time in times:
        tau = 1.0 - time
        spread = tau * time
        weights.append(max_weight if spread <= 0 else min(max_weight, (tau**2 + time**2) / spread))
    return tuple(weights)


def end_of(prefix: Prefix) -> int:
    """First row that is not guided: the horizon, limited to the left-over rows.

    A left-over padded to the horizon would pull towards invented rows, the mean action.
    """
    rows = len(prefix.rows)
    return rows if prefix.horizon is None else min(prefix.horizon, rows)


def padded(rows: F32, shape: tuple[int, int]) -> F32:
    """Pad `rows` with zeros to float32 of `shape` (H, A)."""
    out = np.zeros(shape, dtype=np.float32)
    count = min(len(rows), shape[0])
    out[:count, : rows.shape[1]] = rows[:count]
    return out
