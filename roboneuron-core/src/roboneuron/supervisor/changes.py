"""One condition for all that can happen to modules: reports, answers, exits and cancellations wake every waiter."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_POLL_S = 0.05
"""Facts that nobody announces (a service discovered) are looked at this often."""


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

    def wait_for(self, look: Callable[[], T | None], timeout_s: float) -> T | None:
        """Return the first result of `look` that is neither None nor False, or None after `timeout_s`.

        `look` runs on the waiting thread without any lock, and may raise to end the wait.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            seen = self._version
            found = look()
            if found is not None and found is not False:
                return found
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                return None
            with self._condition:
                self._condition.wait_for(lambda: self._version != seen, min(remaining_s, _POLL_S))  # noqa: B023
