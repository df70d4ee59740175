"""At most so many calls per second."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable


class RateLimit:
    """A sliding window over accepted calls of one endpoint; safe from any thread."""

    def __init__(self, rate_hz: float, clock: Callable[[], float]) -> None:
        """Args:
        rate_hz: most calls per second; 0 for no bound. Below 1 the window is as long as one call takes its turn.
        clock: monotonic time [s].
        """
        self._window_s = max(1.0, 1.0 / rate_hz) if rate_hz else 0.0
        self._most = max(1, int(rate_hz * self._window_s + 1e-9)) if rate_hz else 0
        self._clock = clock
        self._calls: deque[float] = deque()
        self._lock = threading.Lock()

    def wait_s(self) -> float:
        """Seconds until another call would be accepted; 0 for now. Takes nothing."""
        with self._lock:
            return self._wait_s(self._clock())

    def take(self) -> float:
        """Count a call if it is accepted now; returns 0, or the seconds until it would be."""
        with self._lock:
            now = self._clock()
            wait = self._wait_s(now)
            if wait == 0.0 and self._most:
                self._calls.append(now)
            return wait

    def _wait_s(self, now: float) -> float:
        while self._calls and self._calls[0] <= now - self._window_s:
            self._calls.popleft()
        if not self._most or len(self._calls) < self._most:
            return 0.0
        return max(1e-9, self._calls[0] + self._window_s - now)
