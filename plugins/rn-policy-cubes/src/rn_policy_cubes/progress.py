"""Progress lines of long work: count, rate and remaining time."""

from __future__ import annotations

import time
from collections.abc import Callable

Say = Callable[[str], None]
EVERY_S = 10.0
"""Time between two lines."""


class Progress:
    """Prints a progress line at intervals. Used from one thread.

    Args:
        what: the counted unit, at the start of each line ("step").
        total: final count.
        done: count at the start, which the rate leaves out.
        say: called with each line.
        every_s: time between two lines [s].
        clock: monotonic time [s].
    """

    def __init__(
        self,
        what: str,
        total: int,
        done: int,
        say: Say,
        *,
        every_s: float = EVERY_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what, self._total, self._begun, self._say = what, total, done, say
        self._every_s, self._clock = every_s, clock
        self._begun_s = self._said_s = clock()

    def update(self, done: int, figures: str = "") -> bool:
        """Print a line if one is due or all is done; returns True if one was printed."""
        now_s = self._clock()
        if now_s - self._said_s < self._every_s and done < self._total:
            return False
        self._said_s = now_s
        self._say(
            "".join((self._line(done, now_s - self._begun_s), "; " if figures else "", figures))
        )
        return True

    def _line(self, done: int, passed_s: float) -> str:
        share = f"{self._what} {done}/{self._total} ({100 * done / max(1, self._total):.0f} %)"
        new = done - self._begun
        if new <= 0 or passed_s <= 0:
            return f"{share}, {duration(passed_s)} so far"
        per_s = new / passed_s
        rate = f"{per_s:.1f} a second" if per_s >= 1 else f"{60 * per_s:.1f} a minute"
        left = duration((self._total - done) / per_s)
        return f"{share}, {rate}, {left} left"


def duration(seconds: float) -> str:
    """A duration as text: "40 s", "12 min", "3 h 5 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
