"""Sliding-window rate limit that counts messages."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence


class RateLimit:
    """A sliding window over accepted messages of one endpoint, sent or still to be sent; safe from
    any thread.
    """

    def __init__(self, rate_hz: float, clock: Callable[[], float]) -> None:
        """Args:
        rate_hz: most messages per second; 0 for no bound. Below 1 the window is the time between
            two messages.
        clock: monotonic time [s].
        """
        self.rate_hz = rate_hz
        self._window_s = max(1.0, 1.0 / rate_hz) if rate_hz else 0.0
        self._most = max(1, int(rate_hz * self._window_s + 1e-9)) if rate_hz else 0
        self._clock = clock
        self._sent: list[tuple[float, object]] = []
        # asking and counting are one step: otherwise two callers could both get the last place
        self._lock = threading.Lock()

    def wait_s(self, at_s: Sequence[float] = (0.0,)) -> float:
        """Time until messages would be accepted [s]; 0 for now, infinite for never. Counts nothing.

        Args:
            at_s: time of each message, in seconds from now, in order.
        """
        with self._lock:
            return self._wait_s(self._clock(), at_s)

    def take(self, at_s: Sequence[float] = (0.0,), owner: object = None) -> float:
        """Count messages if all are accepted now; return 0, or as `wait_s`."""
        if not self._most:
            return 0.0
        with self._lock:
            now = self._clock()
            wait = self._wait_s(now, at_s)
            if wait == 0.0:
                self._sent += [(now + offset, owner) for offset in at_s]
            return wait

    def release(self, owner: object) -> None:
        """Remove the owner's future messages, because they will not be sent."""
        with self._lock:
            now = self._clock()
            self._sent = [entry for entry in self._sent if entry[0] <= now or entry[1] is not owner]

    def _wait_s(self, now: float, at_s: Sequence[float]) -> float:
        if not self._most:
            return 0.0
        self._sent = [entry for entry in self._sent if entry[0] > now - self._window_s]
        if self._late(sorted(at_s)) is not None:
            return math.inf
        times = sorted([*(time for time, _ in self._sent), *(now + offset for offset in at_s)])
        late = self._late(times)
        return 0.0 if late is None else max(1e-9, late - now)

    def _late(self, times: Sequence[float]) -> float | None:
        """End of the window for the last message that comes too early; None if none does."""
        most, window_s = self._most, self._window_s
        pairs = zip(times, times[most:], strict=False)
        # rounding of sums
        late = [first + window_s for first, last in pairs if last - first < window_s - 1e-9]
        return late[-1] if late else None
