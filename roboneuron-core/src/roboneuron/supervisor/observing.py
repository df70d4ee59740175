"""Observers of module processes: told what happens to each, before anybody acts on it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

log = logging.getLogger(__name__)


class ProcessObserver(Protocol):
    """What a feature may want to know of module processes; called from any thread, must return quickly."""

    def spawning(self) -> None:
        """Another process is about to be started."""
        ...

    def observe(self, pid: int) -> None:
        """The living process has proved that it works, or is about to be ended: look at it now."""
        ...

    def ended(self, pid: int, name: str) -> None:
        """The process and all that it had started are dead; nobody was told yet."""
        ...


class ProcessObservers:
    """Tells every observer; one that raises is logged and disturbs nobody."""

    def __init__(self) -> None:
        self._observers: list[ProcessObserver] = []

    def add(self, observer: ProcessObserver) -> None:
        """Tell this one too from now on."""
        self._observers.append(observer)

    def spawning(self) -> None:
        """See `ProcessObserver.spawning`."""
        for observer in self._observers:
            _call(observer.spawning)

    def observe(self, pid: int) -> None:
        """See `ProcessObserver.observe`."""
        for observer in self._observers:
            _call(observer.observe, pid)

    def ended(self, pid: int, name: str) -> None:
        """See `ProcessObserver.ended`."""
        for observer in self._observers:
            _call(observer.ended, pid, name)


def _call(method: Callable[..., object], *facts: object) -> None:
    try:
        method(*facts)
    except Exception:  # the border to a feature's own code: processes are started and ended all the same
        log.exception("An observer of processes failed.")
