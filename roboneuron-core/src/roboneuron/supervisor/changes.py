"""Events, bounded waits that every change wakes, and threads that repeat one step."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

log = logging.getLogger(__name__)
Stage = Callable[[str], None]
"""Reports the progress of a long call to its caller; callable from any thread."""
P = ParamSpec("P")
T = TypeVar("T")
_JOIN_S = 2.0
"""Longest wait at the end of a `Periodic` for the step in progress."""
_POLL_S = 0.05
"""Polling period of facts without a notification (a service discovered)."""


class Event(Generic[P]):
    """Listeners of one event; a listener that raises is logged and does not affect the others.

    Listeners are added while the server is assembled, before any event, so no lock is needed.
    """

    def __init__(self) -> None:
        self._listeners: list[Callable[P, object]] = []

    def listen(self, listener: Callable[P, object]) -> None:
        """Register `listener`, called with each event on the thread that raises it; it must return
        quickly.
        """
        self._listeners.append(listener)

    def tell(self, *facts: P.args, **named: P.kwargs) -> None:
        """Call all listeners in their order, on this thread.

        Args:
            facts: arguments for the listeners.
            named: keyword arguments for the listeners.
        """
        for listener in self._listeners:
            try:
                listener(*facts, **named)
            # a failing listener must stop neither the others nor the calling thread
            except Exception:
                log.exception("A listener failed.")


class Lasting:
    """Duration for which a fact has held at every check; used by one thread."""

    def __init__(self) -> None:
        self._since_s = math.inf

    def held_s(self, fact: bool) -> float:
        """Check once more; return the time since the first of the latest checks that all found the
        fact true [s], -inf if it is false.
        """
        now_s = time.monotonic()
        self._since_s = min(self._since_s, now_s) if fact else math.inf
        return now_s - self._since_s


class Changes:
    """Condition variable whose waiters check again after every change, and every 50 ms.

    It has two locks: `lock` for the data, and an internal one for the count of changes. The
    internal lock may be taken while `lock` is held, never the other way round; a waiter checks
    without either.

    Attributes:
        lock: guards the data whose changes are announced; never held while waiting or calling out.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._condition = threading.Condition()
        self._version = 0

    def notify(self) -> None:
        """Announce a change; callable from any thread."""
        with self._condition:
            self._version += 1
            self._condition.notify_all()

    def wait_for(
        self,
        look: Callable[[], T | None],
        timeout_s: float,
        check: Callable[[], object] = lambda: None,
    ) -> T | None:
        """Return the first result of `look` that is neither None nor False, or None after
        `timeout_s`.

        Both run on the waiting thread without any lock, `check` after each unsuccessful `look`;
        both may raise to end the wait.

        Args:
            look: cheap and free of side effects: it runs at least every 50 ms.
            timeout_s: [s]; 0 calls `look` once.
            check: raises if waiting is pointless.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            # read before the check: a change during it ends the wait below at once
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


class Periodic:
    """Calls `step` at once and then every `period_s` [s], on its own thread, from `start` to
    `close`.

    A step that raises is repeated as usual; its error is logged unless the previous one was the
    same. `start` and `close` may be called from any thread, also from the step itself.
    """

    def __init__(self, name: str, period_s: float, step: Callable[[], object]) -> None:
        """Args:
        name: name of the thread.
        period_s: pause between the end of a step and the next one [s].
        step: the function to repeat.
        """
        self._period_s = period_s
        self._step = step
        self._end = threading.Event()
        # taken for good by the first start, so that of two at once only one starts the thread
        self._started = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread; does nothing the second time."""
        if self._started.acquire(blocking=False):
            self._thread.start()

    def close(self) -> None:
        """Stop after the step in progress; idempotent."""
        self._end.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        logged = ""
        while not self._end.is_set():
            try:
                self._step()
            # one failed step must not end a watch that safety depends on
            except Exception as error:
                if repr(error) != logged:
                    logged = repr(error)
                    log.exception("A step of %r failed.", self._thread.name)
            self._end.wait(self._period_s)
