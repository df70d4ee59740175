"""Latency of answers, and the number of rows played meanwhile."""

from __future__ import annotations

import math
import statistics
from collections import deque

WINDOW = 50
"""Number of answers in the sliding window: an old spike (a recording, a page fault) must not slow
the arm permanently.
"""


class LatencyWindow:
    """Latencies from capture to answer [s], the newest `WINDOW` of them. Used from one thread.

    The first answer after a load, a reset or a handover is not typical (caches, allocations).
    `skip_next` excludes it, unless it is the only one.
    """

    def __init__(self, size: int = WINDOW) -> None:
        self._values: deque[float] = deque(maxlen=size)
        self._first: float | None = None
        self._skip = True

    def skip_next(self) -> None:
        """Exclude the next value."""
        self._skip = True

    def add(self, latency_s: float) -> None:
        """Add one latency [s]."""
        if self._skip:
            self._skip, self._first = False, latency_s
        else:
            self._values.append(latency_s)

    @property
    def is_known(self) -> bool:
        """True if there is more than the first answer."""
        return bool(self._values)

    @property
    def p50_s(self) -> float | None:
        """Median [s]; None before the first answer."""
        return statistics.median(self._values) if self._values else self._first

    @property
    def p99_s(self) -> float | None:
        """99th percentile [s], for so few values the maximum; None before the first answer."""
        return max(self._values) if self._values else self._first


def rows_in(duration_s: float, step_s: float) -> int:
    """Largest number of rows of `step_s` played in `duration_s`."""
    return math.ceil(duration_s / step_s - 1e-9)
