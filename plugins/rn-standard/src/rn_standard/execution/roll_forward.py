"""The state that a backend trained on predicted states gets: the measured one after the rows still
to be played.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron import Action, Pose, apply_delta

F64 = NDArray[np.float64]


def roll_forward(
    pose: Pose, gripper_open: float | None, rows: F64, done_share: float = 0.0
) -> tuple[Pose, float | None]:
    """Return pose and opening after `rows`.

    Commands overstate motion where the arm lags behind; joints cannot be rolled from TCP deltas.

    Args:
        pose: measured, of the TCP in the base frame.
        gripper_open: measured, 0 closed .. 1 open; None stays None.
        rows: float64 (N, 7), oldest first, contract units.
        done_share: of the first row, carried out when the pose was measured, 0 .. 1; its rotation
            vector is scaled.

    Source: VLASH, arXiv 2512.01031, for absolute actions; here for TCP deltas in the base frame.
    """
    for i, row in enumerate(rows):
        left = 1.0 - done_share if i == 0 else 1.0
        pose = apply_delta(
            pose,
            Action(translation_m=row[:3] * left, rotation_rad=row[3:6] * left, gripper_open=1.0),
        )
        gripper_open = None if gripper_open is None else float(row[6])
    return pose, gripper_open
