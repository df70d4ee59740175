"""What a server has done so far, in numbers."""

from __future__ import annotations

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


class Statistics:
    """Counts batches and answers; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._took_s: deque[float] = deque(maxlen=_RECENT)
        self._busy_since_s: float | None = None

    def timed(self, predict: Predict) -> Predict:
        """The same function, with the time of each batch noted."""

        def timed(observations: Sequence[Observation]) -> Sequence[Answer]:
            began_s = self._busy_since_s = time.monotonic()
            try:
                return predict(observations)
            finally:
                with self._lock:
                    self._busy_since_s = None
                    self._took_s.append(time.monotonic() - began_s)
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

    def values(self) -> Document:
        """All of it; times of the model are of the last thousand batches [ms]."""
        with self._lock:
            counts, took_ms = dict(self._counts), np.array(self._took_s) * 1e3
            busy_since_s = self._busy_since_s
        names = ("batches", "observations", "answered", "refused", "errors")
        return {
            **{name: counts.get(name, 0) for name in names},
            "model_ms_median": float(np.median(took_ms)) if len(took_ms) else None,
            "model_ms_p99": float(np.percentile(took_ms, 99)) if len(took_ms) else None,
            "busy_s": 0.0 if busy_since_s is None else time.monotonic() - busy_since_s,
        }
