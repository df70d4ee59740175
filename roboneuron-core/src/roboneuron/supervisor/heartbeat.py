"""The server's sign of life to its modules: a byte on their stdin, five times a second.

A module whose server has ended sees the end of stdin. One whose server is frozen, so that nobody could stop the arm,
misses these bytes; control holds then.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable

from roboneuron.supervisor.process import ModuleProcess

PERIOD_S = 0.2


class Heartbeat:
    """Beats to every process from the first `start` to `close`, from a thread of its own."""

    def __init__(self, processes: Callable[[], Iterable[ModuleProcess]]) -> None:
        self._processes = processes
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin; does nothing the second time."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """End the thread; idempotent."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            for process in self._processes():
                process.beat()
