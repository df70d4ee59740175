"""The rows of chunks that are still to be sent."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Literal

from roboneuron.contract import ActionChunk
from roboneuron.contract.arrays import F64

Outcome = Literal["accepted", "withdrawn", "late", "unconditioned"]
"""What became of an answer. `withdrawn`: made for an earlier instruction or before a stop. `late`: more rows were sent
since its image than it has. `unconditioned`: it continues rows that were not played as promised (trained prefixes)."""


@dataclass(frozen=True, slots=True)
class Row:
    """One action of a chunk.

    Attributes:
        vector: float64 (7,), contract units.
        index, horizon: place in its chunk, and rows of that chunk.
        oldest_ns: capture time of the oldest image that it answers [ns].
        step_s: period of its chunk [s].
        is_border: the first of its chunk that is played.
    """

    vector: F64
    index: int
    horizon: int
    oldest_ns: int
    step_s: float
    is_border: bool


@dataclass
class RowQueue:
    """The rows to be sent, oldest first. Not thread-safe: its owner holds a lock.

    Every instruction, emergency stop and handover begins a new epoch. Answers to observations of an earlier epoch are
    dropped.

    Attributes:
        epoch: of the observations that are taken now.
    """

    epoch: int = 0
    _rows: deque[Row] = field(default_factory=deque)
    _context: Any = None

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def next(self) -> Row | None:
        """The row that is sent next."""
        return self._rows[0] if self._rows else None

    def begin_epoch(self) -> None:
        """Forget every row, and every answer under way."""
        self.epoch += 1
        self.drop()

    def drop(self) -> None:
        """Forget the rows that are to be sent; answers under way stay valid."""
        self._rows.clear()
        self._context = None

    def pop(self, sent_ns: int) -> Row:
        """Take the next row out, as sent at that time [ns, clock of the stamps]."""
        return self._rows.popleft()

    def note_sent(self, vector: F64, sent_ns: int) -> None:
        """Another module (the predecessor in a handover) sent a row: it moved the arm in place of our next one."""
        if self._rows:
            self._rows.popleft()

    def append(self, chunk: ActionChunk, epoch: int, *, oldest_ns: int = 0) -> Outcome:
        """Let an answer follow whole after the rows that are there.

        Args:
            chunk: the answer.
            epoch: in which its image was taken.
            oldest_ns: capture time of the oldest image that it answers [ns].
        """
        if epoch != self.epoch:
            return "withdrawn"
        self._rows.extend(rows_of(chunk.actions, chunk, oldest_ns, first=0))
        self._context = chunk.context
        return "accepted"


def rows_of(vectors: F64, chunk: ActionChunk, oldest_ns: int, first: int) -> list[Row]:
    """`vectors`, float64 (N, 7), as the rows of `chunk` from number `first` on."""
    return [
        Row(vector, first + i, len(chunk.actions), oldest_ns, chunk.step_s, is_border=i == 0)
        for i, vector in enumerate(vectors)
    ]
