"""Queue of rows to be sent, and memory of sent rows: a chunk's rows are counted when they are sent,
not timed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Literal

import numpy as np

from roboneuron.contract import EE_DELTA, GRIPPER, ActionChunk, Ahead, ControlSpace
from roboneuron.contract.arrays import F64
from roboneuron.modules.inference import execution

FADE_ROWS = 4
"""Rows over which old deltas are cross-faded into new ones; more rows hardly make the transition
smoother (simulated).
"""
Outcome = Literal["accepted", "late", "unconditioned"]
"""Result of an answer. `late`: more rows were sent since its image than it has. `unconditioned`: it
continues rows that were not played as promised (trained prefixes).
"""
_MEMORY = 512
"""Number of sent rows that are remembered; an older answer is dropped by its image's age long
before.
"""


@dataclass(slots=True)
class _Sent:
    """A sent row; its vector is None for a predecessor's row in another space."""

    sent_ns: int
    vector: F64 | None


@dataclass
class SentRowQueue:
    """The rows to be sent, oldest first, and the sent rows, so that a newer answer can replace the
    rest of a chunk.

    Not thread-safe: its owner holds a lock.

    Attributes:
        rows: rows to be sent.
        fade_rows: length of the cross-fade.
    """

    rows: deque[execution.Row] = field(default_factory=deque)
    fade_rows: int = FADE_ROWS
    _context: object = None
    _sent: deque[_Sent] = field(default_factory=lambda: deque(maxlen=_MEMORY))
    _was_unconditioned: bool = False

    def begin_epoch(self) -> None:
        """Discard every row; sent rows no longer count as played."""
        self._sent.clear()
        self.drop()

    def drop(self) -> None:
        """Discard the rows to be sent."""
        self.rows.clear()
        self._context = None

    def pop(self, sent_ns: int) -> execution.Row:
        """Take the next row, as sent at that time [ns, clock of the stamps]."""
        row = self.rows.popleft()
        self._sent.append(_Sent(sent_ns, row.vector))
        return row

    def note_sent(self, vector: F64 | None, sent_ns: int) -> None:
        """Record a row sent by another module (the predecessor in a handover), which moved the arm
        in place of this queue's next row. None for a row of another space.
        """
        self._sent.append(_Sent(sent_ns, vector))
        if self.rows:
            self.rows.popleft()

    def append(self, chunk: ActionChunk, *, oldest_ns: int = 0) -> Outcome:
        """Append a whole answer to the present rows.

        Args:
            chunk: the answer.
            oldest_ns: capture time of the oldest image behind it [ns].
        """
        self.rows.extend(execution.rows_of(chunk.actions, chunk, oldest_ns, first=0))
        self._context = chunk.context
        return "accepted"

    def sent_since(self, captured_ns: int) -> int:
        """Number of rows sent after that time."""
        return len(self._sent_after(captured_ns))

    def ahead(self, captured_ns: int, committed_rows: int, step_s: float) -> Ahead | None:
        """Input of a backend that conditions on rows: the rows since the capture; None if there are
        none.

        Args:
            captured_ns: capture time of the observation's image [ns].
            committed_rows: rows that will have been sent when the answer comes, in the worst case.
            step_s: period of the rows [s].
        """
        sent = self._sent_after(captured_ns)
        rows = [*sent, *(row.vector for row in self.rows)]
        if not rows or any(row is None for row in rows):
            return None
        # A chunk's row k is aligned with the k-th row sent since its capture, so the running
        # chunk's context is also aligned with the rows sent before its border.
        start = self.rows[0].index - len(sent) if self.rows else -1
        has_context = self._context is not None and start >= 0
        return Ahead(
            rows=np.array(rows, dtype=np.float64),
            committed_rows=min(len(rows), committed_rows),
            step_s=step_s,
            context=self._context if has_context else None,
            context_row=max(start, 0),
        )

    def rows_to_roll(self, measured_ns: int, step_s: float) -> tuple[F64, float]:
        """Rows that move the TCP between a measurement and the end of the queue.

        Args:
            measured_ns: measurement time of the pose [ns].
            step_s: period of the rows [s].

        Returns:
            float64 (N, n), oldest first, and the fraction of the first that was executed at the
            measurement, 0 .. 1. Empty if one of them is of another space.
        """
        period_ns = step_s * 1e9
        under_way = [sent for sent in self._sent if sent.sent_ns > measured_ns - period_ns]
        share = 0.0
        if under_way and under_way[0].sent_ns < measured_ns:
            share = (measured_ns - under_way[0].sent_ns) / period_ns
        rows = [*(sent.vector for sent in under_way), *(row.vector for row in self.rows)]
        if not rows or any(row is None for row in rows):
            return np.zeros((0, 0)), 0.0
        return np.array(rows, dtype=np.float64), share

    def replace(
        self,
        chunk: ActionChunk,
        captured_ns: int,
        *,
        oldest_ns: int = 0,
        max_committed_rows: int = 0,
    ) -> Outcome:
        """Replace the rows from the next one on by an answer.

        Args:
            chunk: its row 0 corresponds to the time of the capture.
            captured_ns: capture time of the leading image [ns].
            oldest_ns: capture time of the oldest image [ns].
            max_committed_rows: longest prefix that the backend was trained for; 0 for no bound.
        """
        played = self.sent_since(captured_ns)
        if played >= len(chunk.actions):
            return "late"
        is_overrun = 0 < chunk.conditioned_rows < played and max_committed_rows > 0
        if is_overrun and not self._was_unconditioned:
            self._was_unconditioned = True
            return "unconditioned"
        self._was_unconditioned = False
        vectors = chunk.actions[played:]
        if not chunk.conditioned_rows or is_overrun:
            fade_rows = fade_rows_of(len(chunk.actions), self.fade_rows)
            old = [row.vector for row in self.rows]
            vectors = cross_fade(old, vectors, fade_rows, chunk.space)
        self.rows.clear()
        self.rows.extend(execution.rows_of(vectors, chunk, oldest_ns, first=played))
        self._context = chunk.context
        return "accepted"

    def _sent_after(self, captured_ns: int) -> list[F64 | None]:
        return [sent.vector for sent in self._sent if sent.sent_ns >= captured_ns]


def fade_rows_of(horizon: int, most: int = FADE_ROWS) -> int:
    """Number of a chunk's rows that are cross-faded: at most `most`, with at least `most` others.

    The motion of a faded row is older than its gripper value, so a short chunk that is faded
    completely would grasp too early.
    """
    return max(0, min(most, horizon - most))


def cross_fade(old: Sequence[F64], new: F64, rows: int, space: ControlSpace = EE_DELTA) -> F64:
    """Return `new` with its first rows faded in from `old`.

    Deltas and velocities are blended as rates of motion, so the arm neither jumps nor catches up.
    Positions and poses are blended as places, so the arm moves from one path to the other. The
    gripper's opening is a decision and is not blended: the new value applies from the start.

    Args:
        old: float64 (n,) each: rows that would be played without the new chunk.
        new: float64 (N, n).
        rows: length of the fade; at most the length of both.
        space: space of both.
    """
    count = min(rows, len(old), len(new))
    if count == 0:
        return new
    faded = np.array(new)
    share = (np.arange(count) + 1.0)[:, None] / (count + 1.0)
    before = np.stack(list(islice(old, count)))
    if space.kind == "ee_pose":
        _align_quaternions(before, new[:count], space)
    moving = [i for i, channel in enumerate(space.channels) if channel.name != GRIPPER]
    blend = (1.0 - share) * before + share * new[:count]
    faded[:count, moving] = blend[:, moving]
    for part in space.quaternions:
        faded[:count, part] /= np.linalg.norm(faded[:count, part], axis=1, keepdims=True)
    return faded


def _align_quaternions(before: F64, after: F64, space: ControlSpace) -> None:
    """Flip the signs of quaternions in place so that a blend uses the shorter rotation."""
    for part in space.quaternions:
        opposite = np.einsum("ij,ij->i", before[:, part], after[:, part]) < 0.0
        before[np.ix_(opposite, part)] *= -1.0
