"""Rates, latencies and counters of a running module; thread-safe, bounded memory."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

_WINDOW_S = 3.0
_SAMPLES = 256


class RateMeter:
    """Events per second over the last three seconds of monotonic time."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._times: deque[float] = deque(maxlen=4096)
        self._lock = threading.Lock()
        self._total = 0

    def tick(self) -> None:
        """Count one event now."""
        with self._lock:
            self._times.append(self._clock())
            self._total += 1

    @property
    def total(self) -> int:
        """Events since the start."""
        return self._total

    def rate_hz(self) -> float:
        """Mean rate over the window; 0 when fewer than two events fell into it."""
        with self._lock:
            now = self._clock()
            while self._times and now - self._times[0] > _WINDOW_S:
                self._times.popleft()
            if len(self._times) < 2:
                return 0.0
            return (len(self._times) - 1) / max(1e-9, self._times[-1] - self._times[0])

    def age_s(self) -> float | None:
        """Seconds since the newest event, or None when there was none in the window's memory."""
        with self._lock:
            return self._clock() - self._times[-1] if self._times else None


class Samples:
    """The last 256 values of something measured in milliseconds."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=_SAMPLES)
        self._lock = threading.Lock()

    def add(self, value_ms: float) -> None:
        """Keep one value [ms]."""
        with self._lock:
            self._values.append(value_ms)

    def median_and_p99(self) -> tuple[float, float] | None:
        """Median and 99th percentile [ms], or None without values."""
        with self._lock:
            values = np.array(self._values)
        if values.size == 0:
            return None
        median, p99 = np.percentile(values, [50, 99])
        return float(median), float(p99)


class Counts:
    """Named counters that never go down ("stale", "non_finite" ...)."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    def add(self, name: str) -> None:
        """Count one event of that name."""
        with self._lock:
            self._counts[name] += 1

    def items(self) -> dict[str, int]:
        """A copy of all counters."""
        with self._lock:
            return dict(self._counts)

    def total(self) -> int:
        """Sum of all counters."""
        with self._lock:
            return self._counts.total()
