"""Events; waiting with a bound, where every change wakes every waiter; and threads that repeat one
step.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

log = logging.getLogger(__name__)
Stage = Callable[[str], None]
"""Tells the caller how far a long call has come; callable from any thread."""
P = ParamSpec("P")
T = TypeVar("T")
_JOIN_S = 2.0
"""Longest wait for the step of a `Periodic` that is under way at its end."""
_POLL_S = 0.05
"""Facts that nobody announces (a service discovered) are looked at this often."""


class Event(Generic[P]):
    """Listeners of one event; a listener that raises is logged and disturbs nobody.

    Listeners are added while the server is put together, before anything happens: that needs no
    lock.
    """

    def __init__(self) -> None:
        self._listeners: list[Callable[P, object]] = []

    def listen(self, listener: Callable[P, object]) -> None:
        """Have `listener` called with each event, on the thread that brings it; it must return
        quickly.
        """
        self._listeners.append(listener)

    def tell(self, *facts: P.args, **named: P.kwargs) -> None:
        """It happened: call all listeners in their order, on this thread.

        Args:
            facts: what listeners are called with.
            named: likewise, by name.
        """
        for listener in self._listeners:
            try:
                listener(*facts, **named)
            # a failing listener must not stop the others, nor the thread that told it
            except Exception:
                log.exception("A listener failed.")


class Lasting:
    """For how long a fact has held at every look; one thread looks."""

    def __init__(self) -> None:
        self._since_s = math.inf

    def held_s(self, fact: bool) -> float:
        """Look once more: time since the first of the last looks that all found it [s], -inf when
        it does not hold.
        """
        now_s = time.monotonic()
        self._since_s = min(self._since_s, now_s) if fact else math.inf
        return now_s - self._since_s


class Changes:
    """A condition variable whose waiters look again after every change, and every 50 ms.

    Two locks: `lock` for the data, and one of its own for the count of changes. The second may be
    taken while the first is held, never the other way round; a waiter looks without either.

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
        self,
        look: Callable[[], T | None],
        timeout_s: float,
        check: Callable[[], object] = lambda: None,
    ) -> T | None:
        """Return the first result of `look` that is neither None nor False, or None after
        `timeout_s`.

        Both run on the waiting thread without any lock, `check` after each look that found nothing;
        both may raise to end the wait.

        Args:
            look: cheap and without effect: it runs at least every 50 ms.
            timeout_s: [s]; 0 looks once.
            check: raises what makes waiting needless.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            # read before the look: a change during the look ends the wait below at once
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
    """Calls `step` at once and then every `period_s` [s], on a thread of its own, from `start` to
    `close`.

    A step that raises is repeated like any other, and logged unless it failed in the same way
    before. `start` and `close` may be called from any thread, also from the step itself.
    """

    def __init__(self, name: str, period_s: float, step: Callable[[], object]) -> None:
        """Args:
        name: of the thread.
        period_s: pause between the end of a step and the next one [s].
        step: repeated.
        """
        self._period_s = period_s
        self._step = step
        self._end = threading.Event()
        # held for ever by the first start, so that of two at once only one starts the thread
        self._started = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin; does nothing the second time."""
        if self._started.acquire(blocking=False):
            self._thread.start()

    def close(self) -> None:
        """End, after the step that may be under way; idempotent."""
        self._end.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        logged = ""
        while not self._end.is_set():
            try:
                self._step()
            # one failing look must not end a watch that safety depends on
            except Exception as error:
                if repr(error) != logged:
                    logged = repr(error)
                    log.exception("A step of %r failed.", self._thread.name)
            self._end.wait(self._period_s)
