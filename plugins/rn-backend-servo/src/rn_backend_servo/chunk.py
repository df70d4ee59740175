"""Chunks of several rows: committed rows are kept, and further rows lead to the goal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.policy import PickPolicy, ServoMotion
from roboneuron import Ahead, matrix_from_rotvec

F64 = NDArray[np.float64]

_HALF_A_ROW = 0.5
"""Delay of the first row after an image: up to one period, half a period on average."""


def kept_rows(ahead: Ahead | None, count: int) -> F64:
    """First rows (N, 7) of a chunk of `count` rows; none if they would fill it."""
    if ahead is None or ahead.committed_rows >= count:
        return np.zeros((0, 7))
    return ahead.rows[: ahead.committed_rows]


def pose_after(tcp: F64, rows: F64, done_rows: float) -> F64:
    """Predict the TCP pose after `rows`.

    Args:
        tcp: measured TCP pose (4, 4).
        rows: float64 (N, 7), oldest first; the first one was due next when the image was taken.
        done_rows: number of rows executed when the pose was measured; a fraction scales a row.

    Returns:
        (4, 4).
    """
    after = tcp.copy()
    for i, row in enumerate(rows):
        left = float(np.clip(i + 1 - done_rows, 0.0, 1.0))
        after[:3, 3] += left * row[:3]
        after[:3, :3] = matrix_from_rotvec(left * row[3:6]) @ after[:3, :3]
    return after


def rows_done(pose_ns: int, captured_ns: int, step_s: float) -> float:
    """Rows executed between the capture of an image and the measurement of a pose; at least 0."""
    return max(0.0, (pose_ns - captured_ns) / 1e9 / step_s - _HALF_A_ROW)


def chunk_rows(policy: PickPolicy, motion: ServoMotion, start: F64, kept: F64, count: int) -> F64:
    """Rows (`count`, 7): `kept`, then `motion` from `start` (4, 4), then further motions towards
    the same goal.
    """
    rows = list(kept)
    here = start
    while len(rows) < count:
        row = np.concatenate([motion.translation_m, motion.rotation_rad, [motion.gripper_open]])
        rows.append(row)
        here = pose_after(here, row[None], 0.0)
        motion = policy.continued(motion, here)
    return np.array(rows)
