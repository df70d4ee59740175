"""Waiting with a bound: reports, answers, exits and cancellations wake every waiter through one condition."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_POLL_S = 0.05
"""Facts that nobody announces (a service discovered) are looked at this often."""


class Lasting:
    """For how long a fact has held at every look."""

    def __init__(self) -> None:
        self._since_s = math.inf

    def held_s(self, fact: bool) -> float:
        """Look once more: time since the first of the last looks that all found it [s], -inf when it does not hold."""
        now_s = time.monotonic()
        self._since_s = min(self._since_s, now_s) if fact else math.inf
        return now_s - self._since_s


class Changes:
    """A condition variable whose waiters look again after every change, and every 50 ms.

    Attributes:
        lock: guards the data whose changes are announced; never held while waiting or calling out.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._condition = threading.Condition()
        self._version = 0

    def notify(self) -> None:
        """Something changed; callable from any thread."""
        with self._condition:
            self._version += 1
            self._condition.notify_all()

    def wait_for(
        self, look: Callable[[], T | None], timeout_s: float, check: Callable[[], object] = lambda: None
    ) -> T | None:
        """Return the first result of `look` that is neither None nor False, or None after `timeout_s`.

        Both run on the waiting thread without any lock, `check` after each look that found nothing; both may raise to
        end the wait.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            seen = self._version
            found = look()
            if found is not None and found is not False:
                return found
            check()
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                return None
            with self._condition:
                self._condition.wait_for(lambda: self._version != seen, min(remaining_s, _POLL_S))  # noqa: B023
