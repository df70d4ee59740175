"""Predictions of a policy and their rows, as inference and its filters pass them on."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from roboneuron.contract import ActionChunk, Observation
from roboneuron.contract.arrays import F64

SEQUENTIAL, OVERLAP = "sequential", "overlap"
"""Modes of predictions: the rows follow the present ones, or replace them."""


@dataclass(frozen=True, slots=True)
class Row:
    """One action of a chunk.

    Attributes:
        vector: float64 (n,), contract units, in the space of its chunk.
        index, horizon: position in its chunk, and number of rows of that chunk.
        oldest_ns: capture time of the oldest image behind it [ns].
        step_s: period of its chunk [s].
        is_border: the first played row of its chunk.
    """

    vector: F64
    index: int
    horizon: int
    oldest_ns: int
    step_s: float
    is_border: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """One prediction in progress.

    Attributes:
        observation: input of the backend.
        captured_ns: capture time of the leading image [ns].
        epoch: epoch of the capture.
        mode: use of its answer.
    """

    observation: Observation
    captured_ns: int
    epoch: int
    mode: str = SEQUENTIAL


@dataclass(frozen=True, kw_only=True, slots=True)
class PredictionRequest:
    """What the policy is asked.

    Attributes:
        prediction: with the input of the policy.
        measured: its observation without additions and predictions of the executor.
        resets: the instruction is new; the policy is reset.
        stop: set when the work ends.
    """

    prediction: Prediction
    measured: Observation
    resets: bool
    stop: threading.Event


@dataclass(frozen=True, kw_only=True, slots=True)
class AnsweredPrediction:
    """A chunk, with the prediction that it answers; `stop` as of its request."""

    prediction: Prediction
    chunk: ActionChunk
    stop: threading.Event


@dataclass(frozen=True, kw_only=True, slots=True)
class Bounds:
    """Bounds of the age of the image behind a row at the time of sending.

    Attributes:
        first_s: for the first row of an answer [s].
        tail_s: for the later rows [s]; None for `first_s` plus the length of the chunk.
    """

    first_s: float
    tail_s: float | None = None

    def of(self, row: Row) -> float:
        """Bound for that row [s]."""
        if row.is_border:
            return self.first_s
        return self.first_s + row.horizon * row.step_s if self.tail_s is None else self.tail_s
