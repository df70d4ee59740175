"""Statistics of a server, and its page with them at a local socket."""

from __future__ import annotations

import bisect
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from http import HTTPStatus
from http.client import HTTPException, HTTPResponse
from pathlib import Path

import numpy as np

from rn_backend_openpi.batching import Answer
from rn_backend_openpi.messages import Document
from roboneuron import ForeignDataError, NotReadyError, Observation, RoboNeuronError, foreign

_RECENT = 1000
"""Number of batches whose times are kept."""
STATUS = "/status"
"""Page with a server's statistics; on local sockets only."""
_LONGEST_S = 20.0
Predict = Callable[[Sequence[Observation]], Sequence[Answer]]
BOUNDS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper bounds of the histogram of times [s]."""


class Times:
    """Histogram of times; from one thread at a time."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def note(self, took_s: float) -> None:
        """Add one time."""
        self._counts[bisect.bisect_left(BOUNDS_S, took_s)] += 1
        self._sum_s += took_s

    def document(self) -> Document:
        """Counts per interval, up to each bound, the last one above all bounds; and the sum [s]."""
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
        """The same function, with measurement of the time of each batch."""

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
        """Count an answer to a robot: a chunk, a refusal for lack of time or space, or an error."""
        kind = "answered"
        if isinstance(answer, RoboNeuronError):
            kind = "refused" if isinstance(answer, NotReadyError) else "errors"
        with self._lock:
            self._counts[kind] += 1
            if not isinstance(answer, RoboNeuronError):
                self._queue.note(answer.metrics.get("shared.queue_ms", 0.0) / 1e3)

    def values(self) -> Document:
        """All statistics; the model's times are those of the last thousand batches [ms]."""
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


def page(path: Path, timeout_s: float) -> Document:
    """The status of the server at a local socket. Raises OSError or ForeignDataError."""
    with socket.socket(socket.AF_UNIX) as connected:
        connected.settimeout(timeout_s)
        connected.connect(str(path))
        connected.sendall(f"GET {STATUS} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        with HTTPResponse(connected) as answer:
            try:
                answer.begin()
                data = answer.read(foreign.MOST_BYTES)
            except HTTPException as error:
                raise ForeignDataError(f"a status is no answer of HTTP: {error!r}") from error
            if answer.status != HTTPStatus.OK:
                raise ForeignDataError(f"a status is refused: {answer.status}")
    return foreign.table(foreign.decode_json(data, "a status"), "a status")


def ask_status(path: Path) -> Document:
    """Status of the policy server at a local socket.

    Raises:
        NotReadyError: there is no server.
    """
    try:
        told = page(path, _LONGEST_S)
        foreign.field(told, "models")
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise NotReadyError(
            "No policy server of this file runs on this machine as this user.",
            hint="Start it with `roboneuron policy serve`.",
        ) from error
    except (OSError, ForeignDataError) as error:
        raise NotReadyError(f"The policy server does not answer: {error}.") from error
    return told
