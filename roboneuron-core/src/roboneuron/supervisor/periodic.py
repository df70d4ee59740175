"""A thread that repeats one step: heartbeats, watches of health, memory, leases and the ROS graph."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)
_JOIN_S = 2.0


class Periodic:
    """Calls `step` at once and then every `period_s` [s], on a thread of its own, from `start` to `close`.

    A step that raises is repeated like any other, and logged unless it failed in the same way before. `start` and
    `close` may be called from any thread, also from the step itself.
    """

    def __init__(self, name: str, period_s: float, step: Callable[[], object]) -> None:
        self._period_s = period_s
        self._step = step
        self._end = threading.Event()
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
        told = ""
        while not self._end.is_set():
            try:
                self._step()
            except Exception as error:  # one failing look must not end a watch that safety depends on
                if repr(error) != told:
                    told = repr(error)
                    log.exception("A step of %r failed.", self._thread.name)
            self._end.wait(self._period_s)
