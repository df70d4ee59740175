"""The feature: incident records, restarts, memory limits and the server's log."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

from rn_standard.ops.incidents import FOLDER, Incidents
from rn_standard.ops.memory import MemoryWatch
from rn_standard.ops.options import OpsOptions
from rn_standard.ops.other_servers import ServerPresence
from rn_standard.ops.records import SERVER, log_resource, record_tools
from rn_standard.ops.restarts import Restarts
from rn_standard.ops.server_log import ServerLog
from roboneuron import Feature, Host, Resource, Tool
from roboneuron.feature import (
    EXPLANATIONS,
    FAULTS,
    ClosedLoop,
    Health,
    ModuleKind,
    ModuleView,
    Periodic,
    settings,
)
from roboneuron.tools.loop.results import ModuleStatus

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


log = logging.getLogger(__name__)
_ACTIONS = 30
_ORDINARY = frozenset({"ungrounded"})
"""Errors that are not faults: an instruction that a backend cannot follow is a regular answer."""


class Operations(Feature[OpsOptions]):
    """Records the faults of one server, and restarts and ends module processes as configured."""

    _incidents: Incidents
    _restarts: Restarts | None = None
    _memory: MemoryWatch | None = None
    _faults: SafetyFaults | None = None

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return get_logs and list_incidents."""
        self._host = host
        self._incidents = Incidents(
            host.state_directory / FOLDER, robot=lambda: str(host.loop.robot_facts)
        )
        self._restarts = Restarts(host.loop, self.options, self._note_restart, self._before_restart)
        self._memory = MemoryWatch(host.modules, self.options.memory_limit_mb, self._note_memory)
        self._faults = SafetyFaults(host.loop, host.events.fault.tell)
        self._log = ServerLog(host.modules.log_directory)
        host.events.open.listen(self._log.open)
        self._presence = ServerPresence(host.state_directory)
        host.events.open.listen(self._tell_of_other_servers)
        host.events.end.listen(self._presence.close)
        host.events.end.listen(self._log.close)
        host.events.stop.listen(self._restarts.cancel)
        host.events.health.listen(self._record)
        host.events.health.listen(self._restarts.on_health)
        host.events.fault.listen(self._incidents.record)
        return record_tools(host.modules, self._incidents)

    def recent_faults(self, within_s: float) -> tuple[int, list[str], float]:
        """See `Incidents.recent`."""
        return self._incidents.recent(within_s)

    def resources(self, host: Host) -> Sequence[Resource]:
        """Return the logs of modules and of the server."""
        return [log_resource(host.modules, source) for source in (*host.modules.slots, SERVER)]

    def _tell_of_other_servers(self) -> None:
        for pid in self._presence.open():
            log.warning(
                "Another server (pid %d) uses the state directory %s too. They share its "
                "emergency stop, its audit and "
                "its records, and a robot can be started in one of them only. If you did not mean "
                "that, end one of "
                "them, or give each a [supervisor] state_directory of its own.",
                pid,
                self._host.state_directory,
            )

    def start(self, host: Host) -> None:
        """Start watching the memory of modules, and the counters."""
        assert self._memory is not None
        assert self._faults is not None
        self._memory.start()
        self._faults.start()

    def close(self) -> None:
        """Stop restarts and watches; the log continues until the server has ended."""
        if self._restarts is not None:
            self._restarts.close()
        for watch in (self._memory, self._faults):
            if watch is not None:
                watch.close()

    def _record(self, view: ModuleView, before: Health, health: Health) -> None:
        self._incidents.spans.change(view.kind, before, health)
        if health not in FAULTS:
            return
        if health == "failing" and view.report is not None and view.report.error_code in _ORDINARY:
            return
        status = ModuleStatus.of(view).model_dump(mode="json")
        lines = list(view.process.last_lines()) if view.process is not None else []
        self._incidents.record(
            view.kind,
            health,
            {
                "before": before,
                "explanation": EXPLANATIONS[health],
                "status": status,
                "log": lines,
                "actions": self._last_actions(),
            },
        )

    def _last_actions(self) -> list[dict[str, object]]:
        stream = self._host.loop.streams.get(self._host.config.namespace)
        newest = list(stream.copy())[-_ACTIONS:] if stream is not None else []
        return [{"sent_ns": at, "values": list(values)} for at, values in newest]

    def _before_restart(self, kind: ModuleKind) -> None:
        self._host.loop.starts.stop(
            kind, f"{kind} is started again after a failure", is_asked=False
        )

    def _note_restart(self, kind: ModuleKind, what: str) -> None:
        log.warning("%s: %s.", kind, what)
        self._host.events.fault.tell(kind, "restart", {"explanation": what})

    def _note_memory(self, kind: ModuleKind, what: str) -> None:
        facts = {"explanation": what, "actions": self._last_actions()}
        self._host.events.fault.tell(kind, "memory", facts)
