"""Execution of action chunks, one whole chunk after the other: when to predict, which row to send
and when.

Everything is decided here under one lock; the threads that call it, one to predict and one to play,
hold no state. Time comes from outside, so that tests and simulations run it by a virtual clock. A
feature may put an executor of its own, derived from this one, in its place
(`MAKE_EXECUTOR`).
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from roboneuron import F64, ActionChunk, BackendSpec, ConfigurationError, NotReadyError, Observation

if TYPE_CHECKING:
    from roboneuron.node import ModuleHost

_PACE = 0.8
"""The next image may be taken after this share of a step since the last row went out: the arm has
then carried out most of it.
"""
_LEAST_WAIT_S = 0.001
"""Of the predicting thread: a wait of nothing at all would keep the lock from the playing one."""
_RESYNC = 0.5
"""A row that is later than this share of a period starts the period anew; less is jitter, and the
grid is kept.
"""

_ROUNDING = 1e-6
"""Of a horizon that is a whole number of periods."""
SEQUENTIAL, OVERLAP = "sequential", "overlap"
"""Modes of predictions: the rows follow those that are there, or replace them."""
FALLBACK = "fallback"
"""As `sequential`, by the second policy, see `rn_standard.inference.fallback`."""
ACTING, REASON, COUNT = "fallback.acting", "fallback.reason", "fallback.count"
"""In the status, where there is a second policy: which one acts, why not the first, and how often
the second has taken over.
"""


@dataclass(frozen=True, slots=True)
class Row:
    """One action of a chunk.

    Attributes:
        vector: float64 (n,), contract units, in the space of its chunk.
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


def rows_of(vectors: F64, chunk: ActionChunk, oldest_ns: int, first: int) -> list[Row]:
    """`vectors`, float64 (N, n), as the rows of `chunk` from number `first` on."""
    return [
        Row(vector, first + i, len(chunk.actions), oldest_ns, chunk.step_s, is_border=i == 0)
        for i, vector in enumerate(vectors)
    ]


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """One prediction under way.

    Attributes:
        observation: what the backend gets.
        captured_ns: capture time of the leading image [ns].
        epoch: in which it was captured.
        mode: how its answer will be used.
    """

    observation: Observation
    captured_ns: int
    epoch: int
    mode: str = SEQUENTIAL


@dataclass(frozen=True, kw_only=True, slots=True)
class Bounds:
    """How old the image behind a row may be when the row is sent.

    Attributes:
        first_s: for the first row of an answer [s].
        tail_s: for the rows after it [s]; None: `first_s` and the length of the chunk.
    """

    first_s: float
    tail_s: float | None = None

    def of(self, row: Row) -> float:
        """The bound of that row [s]."""
        if row.is_border:
            return self.first_s
        return self.first_s + row.horizon * row.step_s if self.tail_s is None else self.tail_s


class ChunkExecutor:
    """Decides for one backend. Thread-safe.

    Every instruction, emergency stop and handover begins a new epoch. Answers to observations of an
    earlier epoch are dropped.

    Args:
        bounds: ages of images.

    Attributes:
        changed: held while anything is decided; notified when rows arrive or are sent, and when an
            epoch begins.
    """

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._rows: deque[Row] = deque()
        self._epoch = 0
        self._step_s: float | None = None
        self._due_s = 0.0
        self._predecessor_s = -math.inf
        self.changed = threading.Condition(threading.RLock())

    # -- who predicts

    def wants_prediction(self, now_s: float) -> bool:
        """Whether the next image is to be predicted on, at that monotonic time [s]."""
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
                # Between two chunks of sequential execution nothing but time makes a prediction
                # wanted.
                is_paced = not self._rows and self._step_s is not None
                wait_s = (
                    self._due_s - (1.0 - _PACE) * (self._step_s or 0.0) - now_s
                    if is_paced
                    else end_s - now_s
                )
                self.changed.wait(max(_LEAST_WAIT_S, min(wait_s, end_s - now_s)))
        return False

    def begin(self, observation: Observation, captured_ns: int) -> Prediction:
        """Say what the backend is given of an observation that is there now.

        Args:
            observation: measured, without `ahead`.
            captured_ns: capture time of the image that paces the loop [ns].
        """
        with self.changed:
            return Prediction(observation=observation, captured_ns=captured_ns, epoch=self._epoch)

    def answer(self, prediction: Prediction, chunk: ActionChunk, now_ns: int) -> str:
        """Take an answer over; returns "accepted", or a word for why the rows stay as they are.

        "withdrawn": it was made for an earlier instruction or before a stop. A feature's executor
        has words of its own.

        Args:
            prediction: what `begin` returned.
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
        """Learn from an answer that is not played, in shadow, as `answer` does from every one."""
        with self.changed:
            self._step_s = chunk.step_s

    # -- who plays

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
        """How long before the end of such a chunk the next prediction begins at the earliest
        [s].
        """
        return (1.0 - _PACE) * chunk.step_s

    def planned(self, step_s: float, horizon_s: float) -> list[F64]:
        """Rows that are to be sent within `horizon_s` after the one that was taken last, at its
        period `step_s`.

        Rows that the predecessor of a handover plays are none of them.
        """
        with self.changed:
            count = int(horizon_s / step_s + _ROUNDING)
            rows = [row for row in self._rows if row.step_s == step_s]
            return [row.vector for row in rows[:count]]

    def play(self, now_s: float, now_ns: int) -> Row | None:
        """Take the row that is due, to be sent at once while the caller holds `changed`.

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
        """Count a row that the predecessor of a handover sent; the next row is due a period after
        it. None: a row of another space.
        """
        with self.changed:
            self._predecessor_s = now_s
            if self._rows:
                self._rows.popleft()

    # -- what interrupts

    def begin_epoch(self) -> None:
        """Begin with another instruction, after a stop or a start: no row and no answer of before
        is played.
        """
        with self.changed:
            self._epoch += 1
            self.drop()

    def drop(self) -> None:
        """Send no more of the rows; the successor of a handover plays."""
        with self.changed:
            self._rows.clear()
            self.changed.notify_all()

    def values(self) -> dict[str, str | float | int]:
        """What the status tells of execution: numbers and words by name, without those that are
        unknown.
        """
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
    """The executor of a module that no feature has given another one.

    Args:
        backend: descriptor of what predicts.
        execution: `inference.execution` of the configuration.
        bounds: ages of images.

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


MakeExecutor = Callable[[BackendSpec, str, Bounds], ChunkExecutor]
"""Makes what executes the chunks of a backend, called as `make_sequential`."""
MAKE_EXECUTOR = "make_executor"
"""Under this name in `ModuleHost.lent` a feature puts a MakeExecutor of its own."""


def executor_maker(host: ModuleHost) -> MakeExecutor:
    """What makes the executor of a module: a feature's, or `make_sequential`."""
    return cast("MakeExecutor", host.lent.get(MAKE_EXECUTOR, make_sequential))
