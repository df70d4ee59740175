"""How modules are: what they say of themselves on /diagnostics, and a word for each, looked at
every 30 ms.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field, SkipValidation

from roboneuron.config import LimitsConfig, ModuleSettings
from roboneuron.modules.report import Report
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.planning import Plan
from roboneuron.supervisor.changes import Changes, Periodic
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents
from roboneuron.supervisor.slot import Phase, Slot

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus


_KINDS = tuple(f"/{kind}" for kind in MODULE_KINDS)
_FOREIGN_S = 1.0
"""A node that reports every 0.2 s and was not heard for this long is gone."""
_FOREIGN = 64
"""So many names of other servers' modules are kept: anybody may invent names on /diagnostics."""


log = logging.getLogger(__name__)
Health = Literal[
    "stopped",
    "starting",
    "stopping",
    "ok",
    "waiting",
    "failing",
    "stalled",
    "stuck",
    "silent",
    "exited",
]
FAULTS: frozenset[Health] = frozenset({"failing", "stalled", "stuck", "silent", "exited"})
SILENT_S = 0.42
"""A module reports every 0.2 s; without a report for this long it is frozen, or its machine is
overloaded.
"""
STUCK_S = 0.3
"""A module's executor turns every 0.02 s; the age it reports grows for up to one period more."""
LOOK_S = 0.03
"""Period of the watch: `SILENT_S` and this together stay below the half second within which a fault
is reported.
"""
EXPLANATIONS: dict[Health, str] = {
    "stopped": "not running",
    "starting": "being started",
    "stopping": "being stopped",
    "ok": "working",
    "waiting": "running, but something is missing",
    "failing": "running, but reporting an error",
    "stalled": "reporting, but making no progress",
    "stuck": "reporting, but not handling messages and requests",
    "silent": "alive, but not reporting",
    "exited": "its process ended by itself",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class ModuleView:
    """What is known of one module.

    Attributes:
        kind, phase: which one, and what the supervisor is doing with it.
        process: None when there is none; of a module that has ended by itself, the ended one.
        plan, settings: what it was started with, and what its process was told.
        report: its newest status, None before the first.
    """

    kind: ModuleKind
    phase: Phase
    process: ModuleProcess | None = None
    plan: Plan | None = None
    settings: ModuleSettings | None = None
    report: Report | None = None

    def health(self, now_s: float) -> Health:
        """How the module is; of several faults the one that explains the others.

        A module that does not report says nothing else either; one whose executor hangs makes no
        progress; one that is stalled may report an older error.

        Args:
            now_s: monotonic time [s].
        """
        if self.phase != "running":
            return self.phase
        report = self.report
        if report is None or now_s - report.received_s > SILENT_S:
            return "silent"
        if report.loop_age_s is not None and report.loop_age_s > STUCK_S:
            return "stuck"
        age_s, limit_s = report.work_age_s, report.work_limit_s
        if age_s is not None and limit_s is not None and age_s > limit_s:
            return "stalled"
        if report.error_code:
            return "failing"
        return "ok" if report.ready else "waiting"


class Stopped(BaseModel):
    """A module that is gone from the process table, or a start that was cancelled.

    Attributes:
        took_s: from the call to the process reaped.
        report: the last one that came.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    module: ModuleKind
    cancelled_start: bool = Field(default=False, description="it was still starting")
    pid: int | None = None
    exit_code: int | None = Field(default=None, description="negative for the signal that ended it")
    killed: bool = Field(default=False, description="it did not leave by itself in time")
    took_s: float = 0.0
    report: SkipValidation[Report | None] = Field(default=None, exclude=True)


class Modules:
    """The modules of one server and their processes, as features may read them and be told of them.

    Args:
        log_directory: where this server's modules log, one file for each.
        on_change: called from any thread, with the kind, when a module started, stopped or ended by
            itself.

    Attributes:
        changes: told of all that happens to modules; its lock guards `slots`.
        slots: by kind, the one of the module that works first; others are about to replace it, or
            were replaced.
        log_directory: as given.
        process_events: what happens to module processes, for listeners.
        tightened: limits that modules are started with instead of the configured ones, None for
            these; the feature that tightens them sets it.
        secret_variables: environment variables that modules do not get; features may add some.
    """

    def __init__(self, log_directory: Path, on_change: Callable[[ModuleKind], object]) -> None:
        self.log_directory = log_directory
        self.on_change = on_change
        self.process_events = ProcessEvents()
        self.tightened: LimitsConfig | None = None
        self.secret_variables: set[str] = set()
        self.changes = Changes()
        self.slots = {kind: [Slot(kind, self.changes)] for kind in MODULE_KINDS}
        # process ids of all that was started, as text: that is how they come in a DiagnosticStatus
        self._ours: set[str] = set()
        self._foreign: dict[str, tuple[str, float]] = {}

    def slot(self, kind: ModuleKind) -> Slot:
        """The slot of the module that works now; another one after a replacement, so that it is not
        to be kept.
        """
        with self.changes.lock:
            return self.slots[kind][0]

    def receive(self, message: DiagnosticArray) -> None:
        """Subscription callback of /diagnostics, on the thread of the ROS link."""
        now_s = time.monotonic()
        with self.changes.lock:
            for status in message.status:
                self._receive(status, now_s)
        self.changes.notify()

    def _receive(self, status: DiagnosticStatus, now_s: float) -> None:
        """Keep what a module reports.

        Args:
            status: of anybody.
            now_s: monotonic time of its arrival.
        """
        name, pid = status.name, status.hardware_id
        if pid in self._ours:  # by any name: a standby's is not that of its kind
            values = {pair.key: pair.value for pair in status.values}
            report = Report.from_values(values, received_s=now_s)
            for slot in self.all_slots():
                slot.accept(name, pid, report)
        elif name.endswith(_KINDS):
            self._foreign = dict(list(self._foreign.items())[-_FOREIGN:])
            self._foreign[name] = (pid, now_s)

    def foreign(self, name: str) -> str | None:
        """Pid of a process of somebody else that reported under `name` within the last second, or
        None.
        """
        with self.changes.lock:
            pid, seen_s = self._foreign.get(name, ("", 0.0))
        return pid if pid and time.monotonic() - seen_s < _FOREIGN_S else None

    def all_slots(self) -> list[Slot]:
        """Those of every kind."""
        with self.changes.lock:
            return [slot for kind in MODULE_KINDS for slot in self.slots[kind]]

    def view(self, kind: ModuleKind) -> ModuleView:
        """What is known of a module now; all of it of one instant, because the lock is held."""
        with self.changes.lock:
            slot = self.slot(kind)
            return ModuleView(
                kind=kind,
                phase=slot.phase,
                process=slot.process,
                plan=slot.plan,
                settings=slot.settings,
                report=slot.report,
            )

    def views(self) -> list[ModuleView]:
        """All modules, in the order robot, perception, inference, control."""
        return [self.view(kind) for kind in MODULE_KINDS]

    def require_running(self, kind: ModuleKind) -> ModuleView:
        """The view of a running module.

        Raises:
            StateError: it is not running; the message says why and what to do.
        """
        with self.changes.lock:
            self.slot(kind).check_running(f"Call start_{kind} first.")
            return self.view(kind)


class Watch(Periodic):
    """A thread that looks at all modules and tells of every change of their health.

    Args:
        views: the modules.
        listener: called from the watching thread with the module, how it was, and how it is; must
            return quickly.
    """

    def __init__(
        self,
        views: Callable[[], Sequence[ModuleView]],
        listener: Callable[[ModuleView, Health, Health], object],
    ) -> None:
        super().__init__("watch", LOOK_S, self.look)
        self._views = views
        self._listener = listener
        self._known: dict[str, Health] = {}

    def look(self) -> None:
        """Compare everything with what is known."""
        now_s = time.monotonic()
        for view in self._views():
            health, before = view.health(now_s), self._known.get(view.kind, "stopped")
            if health == before:
                continue
            self._known[view.kind] = health
            level = logging.WARNING if health in FAULTS else logging.INFO
            log.log(level, "%s: %s (was %s): %s.", view.kind, health, before, EXPLANATIONS[health])
            self._listener(view, before, health)
