"""What happens in a server, told to whoever listens: modules and their health, stops, faults."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.health import Health, ModuleView

log = logging.getLogger(__name__)
HealthListener = Callable[[ModuleView, Health, Health], object]
"""Told the module, how it was, and how it is."""
Listener = Callable[[], object]
KindListener = Callable[[ModuleKind], object]
FaultListener = Callable[[str, str, Mapping[str, Any]], object]
"""Told the module, a word for the fault, and facts that JSON can hold."""


class Events:
    """Listeners by event. They are called on the thread that brings the event and must return quickly.

    Listeners are added while the server is put together; a listener that raises is logged and disturbs nobody.
    """

    def __init__(self) -> None:
        self._open: list[Listener] = []
        self._end: list[Listener] = []
        self._health: list[HealthListener] = []
        self._change: list[KindListener] = []
        self._stop: list[KindListener] = []
        self._fault: list[FaultListener] = []

    def on_open(self, listener: Listener) -> None:
        """Call `listener` first of all when the server begins to serve, before ROS is joined and features start."""
        self._open.append(listener)

    def on_end(self, listener: Listener) -> None:
        """Call `listener` last of all when the server has closed everything; possibly twice, and without `on_open`."""
        self._end.append(listener)

    def on_health(self, listener: HealthListener) -> None:
        """Call `listener` whenever the health of a module changed, at most 30 ms later."""
        self._health.append(listener)

    def on_change(self, listener: KindListener) -> None:
        """Call `listener` when a module started, stopped or ended by itself."""
        self._change.append(listener)

    def on_stop(self, listener: KindListener) -> None:
        """Call `listener` before a module is stopped because somebody asked for it."""
        self._stop.append(listener)

    def on_fault(self, listener: FaultListener) -> None:
        """Call `listener` with each fault that is not a module's health (a lapsed lease, a memory limit)."""
        self._fault.append(listener)

    def tell_open(self) -> None:
        """The server begins to serve."""
        for listener in self._open:
            _call(listener)

    def tell_end(self) -> None:
        """The server has closed everything."""
        for listener in self._end:
            _call(listener)

    def tell_health(self, view: ModuleView, before: Health, health: Health) -> None:
        """A module's health changed."""
        for listener in self._health:
            _call(listener, view, before, health)

    def tell_change(self, kind: ModuleKind) -> None:
        """A module started, stopped or ended."""
        for listener in self._change:
            _call(listener, kind)

    def tell_stop(self, kind: ModuleKind) -> None:
        """A module is about to be stopped on request."""
        for listener in self._stop:
            _call(listener, kind)

    def tell_fault(self, module: str, what: str, facts: Mapping[str, Any]) -> None:
        """Something went wrong that people want to read of later."""
        for listener in self._fault:
            _call(listener, module, what, facts)


def _call(listener: Callable[..., object], *facts: object) -> None:
    try:
        listener(*facts)
    except Exception:  # a failing listener must not stop the others, nor the thread that told it
        log.exception("A listener failed.")
