"""Faults that no change of a module's health would show: a latch file that vanished, requests of foreign nodes."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.modules.settings import FOREIGN_REQUEST, ModuleKind
from roboneuron.server.emergency import EmergencyStop
from roboneuron.server.events import Events
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.supervisor.view import ModuleView


class SafetyReports:
    """Looks whenever the modules are looked at; used by the watching thread only."""

    def __init__(self, supervisor: Supervisor, emergency_stop: EmergencyStop, events: Events) -> None:
        self._supervisor = supervisor
        self._emergency_stop = emergency_stop
        self._events = events
        self._foreign: dict[ModuleKind, int] = {}

    def look(self) -> Sequence[ModuleView]:
        """The modules; faults are told on the way."""
        if restored := self._emergency_stop.take_restored():
            what = "its file vanished without a reset and was written again; everything stays stopped"
            self._events.tell_fault("emergency_stop", "latch_vanished", {"explanation": what, "times": restored})
        views = self._supervisor.views()
        for view in views:
            count = view.report.dropped_by.get(FOREIGN_REQUEST, 0) if view.report is not None else 0
            if count > self._foreign.get(view.kind, 0) and view.report is not None:
                told = {"explanation": view.report.metrics.get(FOREIGN_REQUEST, ""), "count": count}
                self._events.tell_fault(view.kind, FOREIGN_REQUEST, told)
            self._foreign[view.kind] = count
        return views
