"""Latch times of the emergency stop in an episode, from the latch file, and number of releases."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType

_LOOK_S = 0.02


class LatchWatch:
    """Watches the latch file in a thread while entered.

    Attributes:
        latched_s: begin and end of each latch; complete after exit.
        releases: number of releases, by anyone.
    """

    def __init__(self, is_latched: Callable[[], bool], now_s: Callable[[], float]) -> None:
        """Args:
        is_latched: reads the latch file.
        now_s: the episode's clock.
        """
        self._is_latched, self._now_s = is_latched, now_s
        self.latched_s: list[tuple[float, float]] = []
        self.releases = 0
        self._since: float | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="latch-watch", daemon=True)

    def __enter__(self) -> LatchWatch:
        self._look()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._look()
        if self._since is not None:
            self.latched_s.append((self._since, self._now_s()))

    def _watch(self) -> None:
        while not self._stop.wait(_LOOK_S):
            self._look()

    def _look(self) -> None:
        latched, now_s = self._is_latched(), self._now_s()
        if latched and self._since is None:
            self._since = now_s
        elif not latched and self._since is not None:
            self.latched_s.append((self._since, now_s))
            self._since = None
            self.releases += 1
