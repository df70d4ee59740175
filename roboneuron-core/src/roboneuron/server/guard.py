"""What follows from a module's health: notifications, /diagnostics, incident records, restarts; and memory limits."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from roboneuron.modules.settings import FOREIGN_REQUEST, ModuleKind
from roboneuron.server.incidents import FOLDER, Incidents
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.resources import STATUS_URI
from roboneuron.server.results import module_status
from roboneuron.supervisor.memory import MemoryWatch
from roboneuron.supervisor.restarts import Restarts
from roboneuron.supervisor.view import ModuleView
from roboneuron.supervisor.watch import EXPLANATIONS, FAULTS, Health, Watch

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

log = logging.getLogger(__name__)
_ACTIONS = 30
_ORDINARY = frozenset({"ungrounded"})
"""An instruction that a backend cannot follow is an answer, not a fault."""


class Guard:
    """Watches one closed loop from `start` to `close`.

    Args:
        loop: what is watched.
        notify: told the URI of a resource that changed; called from the watching thread.
    """

    def __init__(self, loop: ClosedLoop, notify: Callable[[str], None]) -> None:
        self._loop = loop
        self._notify = notify
        self._publish: Callable[[DiagnosticArray], None] | None = None
        self.incidents = Incidents(loop.supervisor.state_directory / FOLDER)
        self.restarts = Restarts(loop.supervisor, self._note_restart)
        self._memory = MemoryWatch(loop.supervisor, self._note_memory)
        loop.on_stop = self.restarts.cancel
        self._foreign: dict[ModuleKind, int] = {}
        listeners = (self._tell, self._record, self.restarts.on_health, self._diagnose)
        self._watch = Watch(self._look, listeners)

    def start(self) -> None:
        """Begin to watch."""
        self._watch.start()
        self._memory.start()

    def close(self) -> None:
        """End watching and restarting; idempotent."""
        self.restarts.close()
        self._memory.close()
        self._watch.close()

    def _look(self) -> Sequence[ModuleView]:
        """The modules; and what no change of their health would show."""
        if restored := self._loop.emergency_stop.take_restored():
            what = "its file vanished without a reset and was written again; everything stays stopped"
            self.incidents.record("emergency_stop", "latch_vanished", {"explanation": what, "times": restored})
            self._notify(STATUS_URI)
        views = self._loop.supervisor.views()
        for view in views:
            count = view.report.dropped_by.get(FOREIGN_REQUEST, 0) if view.report is not None else 0
            if count > self._foreign.get(view.kind, 0) and view.report is not None:
                told = {"explanation": view.report.metrics.get(FOREIGN_REQUEST, ""), "count": count}
                self.incidents.record(view.kind, FOREIGN_REQUEST, told)
            self._foreign[view.kind] = count
        return views

    def _tell(self, view: ModuleView, before: Health, health: Health) -> None:
        self._notify(STATUS_URI)

    def _record(self, view: ModuleView, before: Health, health: Health) -> None:
        if health not in FAULTS:
            return
        if health == "failing" and view.report is not None and view.report.error_code in _ORDINARY:
            return
        status = module_status(view).model_dump(mode="json")
        lines = list(view.process.last_lines()) if view.process is not None else []
        self.incidents.record(
            view.kind,
            health,
            {
                "before": before,
                "explanation": EXPLANATIONS[health],
                "status": status,
                "log": lines,
                "actions": self._loop.last_actions(_ACTIONS),
            },
        )

    def _note_restart(self, kind: ModuleKind, what: str) -> None:
        log.warning("%s: %s.", kind, what)
        self.incidents.record(kind, "restart", {"explanation": what})
        self._notify(STATUS_URI)

    def _note_memory(self, kind: ModuleKind, what: str) -> None:
        self.incidents.record(kind, "memory", {"explanation": what, "actions": self._loop.last_actions(_ACTIONS)})

    def _diagnose(self, view: ModuleView, before: Health, health: Health) -> None:
        """Say on /diagnostics what a module cannot say itself."""
        if view.choice is None:
            return
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # heavy

        from roboneuron.ros.qos import STATUS
        from roboneuron.ros.topics import DIAGNOSTICS

        link = self._loop.supervisor.link
        if self._publish is None:
            self._publish = link.advertise(DiagnosticArray, DIAGNOSTICS, STATUS)
        level: Any = DiagnosticStatus.OK
        if health in FAULTS:
            level = DiagnosticStatus.STALE if health in ("silent", "stuck") else DiagnosticStatus.ERROR
        told = DiagnosticStatus(
            level=level,
            name=f"{view.choice.settings.config.namespace}/supervisor/{view.kind}",
            message=EXPLANATIONS[health],
            hardware_id=str(os.getpid()),
            values=[KeyValue(key="health", value=health), KeyValue(key="before", value=before)],
        )
        message = DiagnosticArray(status=[told])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        self._publish(message)
