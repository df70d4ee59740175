"""Sequential execution of action chunks: when to predict, which row to send, and when.

All decisions are made here under one lock; the calling threads, one to predict and one to play,
have no state. Time is an argument, so that tests and simulations use a virtual clock. A filter may
offer another executor, derived from this one (`StepFilter.executor`).
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import cast

from roboneuron.contract import ActionChunk, Observation
from roboneuron.contract.arrays import F64
from roboneuron.errors import ConfigurationError, NotReadyError
from roboneuron.modules.predictions import (
    Bounds,
    Prediction,
    Row,
)
from roboneuron.modules.step_filters import StepFilter
from roboneuron.plugins.specs import BackendSpec

__all__ = ["Bounds", "ChunkExecutor", "Prediction", "Row"]
"""Names that other distributions may use."""

_PACE = 0.8
"""Fraction of a step after the last row from which the next image may be used: the arm has then
executed most of that row.
"""
_LEAST_WAIT_S = 0.001
"""Shortest wait of the predicting thread: without a wait it would keep the lock from the playing
thread.
"""
_RESYNC = 0.5
"""Delay of a row, as a fraction of a period, that restarts the period; a smaller one is jitter, and
the time grid is kept.
"""

_ROUNDING = 1e-6
"""Tolerance for a horizon that is a whole number of periods."""
FALLBACK = "fallback"
"""Like `sequential`, but by the second policy, see `roboneuron.modules.inference.fallback`."""


def rows_of(vectors: F64, chunk: ActionChunk, oldest_ns: int, first: int) -> list[Row]:
    """Create the rows of `chunk` from `vectors`, float64 (N, n), numbered from `first`."""
    return [
        Row(vector, first + i, len(chunk.actions), oldest_ns, chunk.step_s, is_border=i == 0)
        for i, vector in enumerate(vectors)
    ]


class ChunkExecutor:
    """Executor of one backend's chunks. Thread-safe.

    Every instruction, emergency stop and handover begins a new epoch. Answers to observations of an
    earlier epoch are dropped.

    Args:
        bounds: ages of images.

    Attributes:
        changed: held during every decision; notified when rows arrive or are sent, and when an
            epoch begins.
    """

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._rows: deque[Row] = deque()
        self._epoch = 0
        self._step_s: float | None = None
        self._due_s = 0.0
        self._predecessor_s = -math.inf
        # reentrant, because `wait_until_wanted` asks `wants_prediction` while it holds it
        self.changed = threading.Condition(threading.RLock())

    # -- prediction

    def admits(self, observation: Observation) -> bool:
        """Whether the policy may act on an observation, which is as new as `Bounds` ask for."""
        return True

    def as_seen(self, observation: Observation) -> Observation:
        """An observation as the policy sees it."""
        return observation

    def wants_prediction(self, now_s: float) -> bool:
        """True if a prediction on the next image is wanted at that monotonic time [s]."""
        with self.changed:
            if self._step_s is None:
                return True
            return not self._rows and now_s >= self._due_s - (1.0 - _PACE) * self._step_s

    def wait_until_wanted(self, stop: threading.Event, timeout_s: float) -> bool:
        """Block until a prediction is wanted; False after `timeout_s` or when `stop` is set."""
        end_s = time.monotonic() + timeout_s
        with self.changed:
            while not stop.is_set():
                now_s = time.monotonic()
                if self.wants_prediction(now_s):
                    return True
                if now_s >= end_s:
                    break
                # Between two chunks of sequential execution only time makes a prediction wanted.
                is_paced = not self._rows and self._step_s is not None
                wait_s = (
                    self._due_s - (1.0 - _PACE) * (self._step_s or 0.0) - now_s
                    if is_paced
                    else end_s - now_s
                )
                self.changed.wait(max(_LEAST_WAIT_S, min(wait_s, end_s - now_s)))
        return False

    def begin(self, observation: Observation, captured_ns: int) -> Prediction:
        """Begin a prediction; return the backend's input.

        Args:
            observation: measured, without `ahead`.
            captured_ns: capture time of the image that paces the loop [ns].
        """
        with self.changed:
            return Prediction(observation=observation, captured_ns=captured_ns, epoch=self._epoch)

    def answer(self, prediction: Prediction, chunk: ActionChunk, now_ns: int) -> str:
        """Accept an answer; return "accepted", or a word for the reason why the rows stay
        unchanged.

        "withdrawn": it was made for an earlier instruction or before a stop. A feature's executor
        has additional words.

        Args:
            prediction: returned by `begin`.
            chunk: the backend's answer.
            now_ns: the time, by the clock of the stamps [ns].
        """
        with self.changed:
            self.measure(prediction, chunk, now_ns)
            outcome = (
                self._put(prediction, chunk) if prediction.epoch == self._epoch else "withdrawn"
            )
            self.changed.notify_all()
            return outcome

    def measure(self, prediction: Prediction, chunk: ActionChunk, now_ns: int) -> None:
        """Update the measurements from an answer that is not played, in shadow, as `answer`
        does.
        """
        with self.changed:
            self._step_s = chunk.step_s

    # -- playing

    @property
    def step_s(self) -> float:
        """Period of the rows of the newest chunk [s]; 0 before the first one."""
        return self._step_s or 0.0

    def due_s(self) -> float | None:
        """Monotonic time at which the next row is to be sent [s]; None without rows."""
        with self.changed:
            return (
                max(self._due_s, self._predecessor_s + self._rows[0].step_s) if self._rows else None
            )

    def end_s(self) -> float | None:
        """Monotonic time at which the last row is to be sent [s]; None without rows."""
        with self.changed:
            due_s = self.due_s()
            if due_s is None:
                return None
            return due_s + sum(row.step_s for row in self._rows) - self._rows[0].step_s

    def lead_s(self, chunk: ActionChunk) -> float:
        """Time before the end of such a chunk at which the next prediction begins at the earliest
        [s].
        """
        return (1.0 - _PACE) * chunk.step_s

    def planned(self, step_s: float, horizon_s: float) -> list[F64]:
        """Rows to be sent within `horizon_s` after the row taken last, at its period `step_s`.

        Rows that the predecessor of a handover plays are excluded.
        """
        with self.changed:
            count = int(horizon_s / step_s + _ROUNDING)
            rows = [row for row in self._rows if row.step_s == step_s]
            return [row.vector for row in rows[:count]]

    def play(self, now_s: float, now_ns: int) -> Row | None:
        """Take the row that is due; the caller sends it at once while holding `changed`.

        Args:
            now_s: monotonic time [s].
            now_ns: the time, by the clock of the stamps [ns].

        Returns:
            None when no row is due.

        Raises:
            NotReadyError: the image behind the row has become too old; the rest of its chunk is
                dropped.
        """
        with self.changed:
            due_s = self.due_s()
            if due_s is None or now_s < due_s:
                return None
            row = self._rows[0]
            age_s, most_s = (now_ns - row.oldest_ns) / 1e9, self._bounds.of(row)
            if age_s > most_s:
                self.drop()
                name = "max_image_age_s" if row.is_border else "max_tail_age_s"
                raise NotReadyError(
                    f"The image behind row {row.index + 1} of {row.horizon} was {age_s:.2f} s old "
                    "when the row was "
                    f"due; {name} = {most_s:g} are allowed, so nothing was published.",
                    hint="Make the backend faster, or allow older images under [inference].",
                )
            self._take(now_ns)
            self._due_s = (now_s if now_s - due_s > _RESYNC * row.step_s else due_s) + row.step_s
            self.changed.notify_all()
            return row

    def note_sent(self, vector: F64 | None, now_s: float, now_ns: int) -> None:
        """Count a row that the predecessor of a handover sent; the next row is due a period later.
        None for a row of another space.
        """
        with self.changed:
            self._predecessor_s = now_s
            if self._rows:
                self._rows.popleft()

    # -- interruptions

    def begin_epoch(self) -> None:
        """Begin a new epoch after another instruction, a stop or a start: earlier rows and answers
        are not played.
        """
        with self.changed:
            self._epoch += 1
            self.drop()

    def drop(self) -> None:
        """Discard the remaining rows; the successor of a handover plays."""
        with self.changed:
            self._rows.clear()
            self.changed.notify_all()

    def values(self) -> dict[str, str | float | int]:
        """Status values of the execution by name, without unknown ones."""
        with self.changed:
            reason = (
                "no feature that executes chunks in another way is installed where this module runs"
            )
            return {"mode": "sequential", "reason": reason, "rows": len(self._rows)}

    def _put(self, prediction: Prediction, chunk: ActionChunk) -> str:
        self._rows.extend(rows_of(chunk.actions, chunk, prediction.observation.stamp_ns, first=0))
        return "accepted"

    def _take(self, sent_ns: int) -> None:
        self._rows.popleft()


def make_sequential(backend: BackendSpec, execution: str, bounds: Bounds) -> ChunkExecutor:
    """Create the default executor of a module, used unless a filter offers one.

    Args:
        backend: descriptor of the backend.
        execution: `inference.execution` of the configuration.
        bounds: bounds of image ages.

    Raises:
        ConfigurationError: another mode is configured.
    """
    if execution not in ("auto", "sequential"):
        raise ConfigurationError(
            f"inference.execution is {execution!r}, which no feature offers where backend "
            f"{backend.name!r} runs.",
            hint="Take rn-execution out of disabled_plugins, or use 'auto'.",
        )
    return ChunkExecutor(bounds)


def executor_of(
    filters: Iterable[StepFilter], backend: BackendSpec, mode: str, bounds: Bounds
) -> ChunkExecutor:
    """Create the executor of the first filter that offers one, without any by `make_sequential`,
    with whose arguments.
    """
    for one in filters:
        made = one.executor(backend, mode, bounds)
        if made is not None:
            return cast("ChunkExecutor", made)
    return make_sequential(backend, mode, bounds)
