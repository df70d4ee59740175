"""Rows that are played while a backend computes: what it needs to continue them without a jump."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.arrays import freeze
from roboneuron.errors import InvalidInputError

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Ahead:
    """Actions between the capture of an observation and the end of what is already planned. A read-only copy.

    Row 0 is the first one sent after the capture, so it is meant for the same moment as row 0 of the new chunk. Some of
    the rows may have been sent when the backend sees them.

    Attributes:
        rows: float64 (N, 7), N >= 0, contract units, oldest first.
        committed_rows: so many of them will be played whatever the backend answers, 0 .. N.
        step_s: their period [s], > 0.
        context: what the running chunk carried as `ActionChunk.context`; None when it carried nothing, or when rows of
            another instruction lie between.
        context_row: row of the running chunk that `rows[0]` is.
        state_ahead_s: `ee_pose` and `gripper_open` of the observation are predicted for this long after the capture
            [s]; 0 when they are measured.

    Raises:
        InvalidInputError: a shape or number is outside of what is said here.
    """

    rows: F64
    committed_rows: int
    step_s: float
    context: Any = None
    context_row: int = 0
    state_ahead_s: float = 0.0

    def __post_init__(self) -> None:
        rows = np.asarray(self.rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 7 or not np.isfinite(rows).all():
            raise InvalidInputError(f"Rows ahead have shape {rows.shape}, expected finite numbers (N, 7).")
        if not 0 <= self.committed_rows <= len(rows) or self.context_row < 0:
            raise InvalidInputError(
                f"committed_rows is {self.committed_rows} of {len(rows)} rows, context_row {self.context_row}."
            )
        if not self.step_s > 0 or self.state_ahead_s < 0:
            raise InvalidInputError(f"step_s is {self.step_s}, state_ahead_s {self.state_ahead_s}: no times ahead.")
        freeze(self, "rows")
