"""What follows from a module's health: incident records and restarts; and memory limits."""

from __future__ import annotations

import logging
from collections.abc import Callable

from roboneuron.modules.settings import ModuleKind
from roboneuron.server.events import Events
from roboneuron.server.incidents import FOLDER, Incidents
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.resources import STATUS_URI
from roboneuron.server.results import module_status
from roboneuron.supervisor.memory import MemoryWatch
from roboneuron.supervisor.restarts import Restarts
from roboneuron.supervisor.view import ModuleView
from roboneuron.supervisor.watch import EXPLANATIONS, FAULTS, Health

log = logging.getLogger(__name__)
_ACTIONS = 30
_ORDINARY = frozenset({"ungrounded"})
"""An instruction that a backend cannot follow is an answer, not a fault."""


class Guard:
    """Watches one closed loop from `start` to `close`.

    Args:
        loop: what is watched.
        events: what it listens to.
        notify: told the URI of a resource that changed; called from the watching thread.
    """

    def __init__(self, loop: ClosedLoop, events: Events, notify: Callable[[str], None]) -> None:
        self._loop = loop
        self._notify = notify
        self.incidents = Incidents(loop.supervisor.state_directory / FOLDER)
        self.restarts = Restarts(loop.supervisor, self._note_restart)
        self._memory = MemoryWatch(loop.supervisor, self._note_memory)
        events.on_stop(self.restarts.cancel)
        events.on_health(self._record)
        events.on_health(self.restarts.on_health)
        events.on_fault(self.incidents.record)

    def start(self) -> None:
        """Begin to watch."""
        self._memory.start()

    def close(self) -> None:
        """End watching and restarting; idempotent."""
        self.restarts.close()
        self._memory.close()

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
