"""A thread that repeats one step while its module is active and reports failures."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from roboneuron.modules.status import StatusWriter

_RETRY_S = 0.05
"""Pause after a failed step; without it a step that fails at once would use a whole core."""
_GIVE_UP_S = 0.1
"""Period of `give_up` in `Worker.stop`: one call may come just before the wait that it should end
begins.
"""
LIMIT_S = 0.4
"""Default time after which a step counts as stalled."""


class Worker:
    """Repeat `step` on one thread between `start` and `stop`.

    A failed step is reported and repeated after 50 ms. `step` gets the event that ends the loop and
    should not block for longer than a fraction of a second, or call `progress` in between.

    Attributes:
        limit_s: time between two signs of progress after which the module counts as stalled.
    """

    def __init__(
        self,
        name: str,
        step: Callable[[threading.Event], None],
        status: StatusWriter,
        *,
        limit_s: float = LIMIT_S,
    ) -> None:
        """Args:
        name: name of the thread, also in the status.
        step: repeated; called with the event that ends the loop.
        status: where failures and progress are reported.
        limit_s: see `limit_s` above [s].
        """
        self._name = name
        self._step = step
        self._status = status
        self.limit_s = limit_s
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def progress(self) -> None:
        """Report that the step makes progress."""
        self._status.tick_work(self._name, self.limit_s)

    def start(self) -> None:
        """Start the thread; it must not be running."""
        # one event per thread: a thread that still hangs in a step stays stopped
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(self._stop,), name=self._name, daemon=True
        )
        self._thread.start()

    def stop(self, timeout_s: float = 2.0, give_up: Callable[[], object] = lambda: None) -> bool:
        """Stop the thread and wait for its end; return False if it still hangs in a step.
        Idempotent.

        Args:
            timeout_s: longest wait for the step in progress [s].
            give_up: called at once and then every 0.1 s while the thread runs, to end what the step
                waits for.
        """
        self._stop.set()
        # Called from the step itself, a wait for its own end would never return.
        thread, self._thread = self._thread, None
        if thread is None or thread is threading.current_thread():
            return True
        deadline_s = time.monotonic() + timeout_s
        while thread.is_alive() and time.monotonic() < deadline_s:
            give_up()
            thread.join(min(_GIVE_UP_S, timeout_s))
        return not thread.is_alive()

    def _run(self, stop: threading.Event) -> None:
        while not stop.is_set():
            self.progress()
            try:
                self._step(stop)
            except Exception as error:  # the module border: plugins may raise anything
                self._status.set_error(error)
                stop.wait(_RETRY_S)
        self._status.end_work(self._name)
