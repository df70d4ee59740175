"""What a server has done so far, in numbers."""

from __future__ import annotations

import bisect
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence

import numpy as np

from rn_backend_shared.batching import Answer
from rn_backend_shared.frames import Document
from roboneuron import NotReadyError, Observation, RoboNeuronError

_RECENT = 1000
"""Batches whose times are remembered."""
Predict = Callable[[Sequence[Observation]], Sequence[Answer]]


BOUNDS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper bounds of the counts of times [s]."""


class Times:
    """Counts times by their size; from one thread at a time."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def note(self, took_s: float) -> None:
        """One more."""
        self._counts[bisect.bisect_left(BOUNDS_S, took_s)] += 1
        self._sum_s += took_s

    def document(self) -> Document:
        """How many lie up to each bound and above the one before, the last ones above all; and
        their sum [s].
        """
        return {"counts": list(self._counts), "sum_s": self._sum_s}


class Statistics:
    """Counts batches and answers; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._took_s: deque[float] = deque(maxlen=_RECENT)
        self._model, self._queue = Times(), Times()
        self._busy_since_s: float | None = None

    def timed(self, predict: Predict) -> Predict:
        """The same function, with the time of each batch noted."""

        def timed(observations: Sequence[Observation]) -> Sequence[Answer]:
            began_s = self._busy_since_s = time.monotonic()
            try:
                return predict(observations)
            finally:
                took_s = time.monotonic() - began_s
                with self._lock:
                    self._busy_since_s = None
                    self._took_s.append(took_s)
                    self._model.note(took_s)
                    self._counts["batches"] += 1
                    self._counts["observations"] += len(observations)

        return timed

    def note(self, answer: Answer) -> None:
        """Count what a robot is told: a chunk, a refusal for lack of time or place, or an error."""
        kind = "answered"
        if isinstance(answer, RoboNeuronError):
            kind = "refused" if isinstance(answer, NotReadyError) else "errors"
        with self._lock:
            self._counts[kind] += 1
            if not isinstance(answer, RoboNeuronError):
                self._queue.note(answer.metrics.get("shared.queue_ms", 0.0) / 1e3)

    def values(self) -> Document:
        """All of it; times of the model are of the last thousand batches [ms]."""
        with self._lock:
            counts, took_ms = dict(self._counts), np.array(self._took_s) * 1e3
            busy_since_s = self._busy_since_s
            times = {"model_times": self._model.document(), "queue_times": self._queue.document()}
        names = ("batches", "observations", "answered", "refused", "errors")
        return {
            **{name: counts.get(name, 0) for name in names},
            **times,
            "model_ms_median": float(np.median(took_ms)) if len(took_ms) else None,
            "model_ms_p99": float(np.percentile(took_ms, 99)) if len(took_ms) else None,
            "busy_s": 0.0 if busy_since_s is None else time.monotonic() - busy_since_s,
        }
