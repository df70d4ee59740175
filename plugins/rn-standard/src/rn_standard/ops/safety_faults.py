"""Faults outside of a module's health: a latch file that vanished, requests of foreign nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from roboneuron.feature import ClosedLoop, ModuleKind, Periodic, settings

_LOOK_S = 0.1
_VANISHED = "its file vanished without a reset and was written again; everything stays stopped"
Fault = Callable[[str, str, Mapping[str, object]], None]
"""Called with the place, a word for the fault, and JSON-serialisable details."""


class SafetyFaults(Periodic):
    """Checks counters every 100 ms: an increase is a fault. The counters of a restarted process
    begin at 0.
    """

    def __init__(self, loop: ClosedLoop, tell: Fault) -> None:
        super().__init__("safety-faults", _LOOK_S, self.look)
        self._loop = loop
        self._tell = tell
        self._restored = 0
        self._foreign: dict[ModuleKind, int] = {}

    def look(self) -> None:
        """Report each fault once. It is unknown which process has removed the file."""
        restored = self._loop.emergency_stop.file.read_state().restored
        if restored > self._restored:
            facts = {"explanation": _VANISHED, "times": restored}
            self._tell("emergency_stop", "latch_vanished", facts)
        self._restored = restored
        for view in self._loop.modules.views():
            report = view.report
            count = 0 if report is None else report.dropped_by.get(settings.FOREIGN_REQUEST, 0)
            if report is not None and count > self._foreign.get(view.kind, 0):
                what = report.metrics.get(settings.FOREIGN_REQUEST, "")
                facts = {"explanation": what, "count": count}
                self._tell(view.kind, settings.FOREIGN_REQUEST, facts)
            self._foreign[view.kind] = count
