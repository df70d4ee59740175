"""Health of modules: their reports on /diagnostics, condensed into one word and checked every 30
ms.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field, SkipValidation

from roboneuron.config import LimitsConfig, ModuleSettings
from roboneuron.gate import StillReason
from roboneuron.modules.report import Report
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.planning import Plan
from roboneuron.supervisor.changes import Changes, Periodic
from roboneuron.supervisor.overload import overload
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents
from roboneuron.supervisor.slot import Phase, Slot, describe_exit, not_running

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus


_FOREIGN_S = 1.0
"""A foreign node, which reports every 0.2 s, counts as gone after this time without a report."""
_FOREIGN = 64
"""Number of foreign modules that are kept: any node may invent names on /diagnostics."""


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
"""A module without a report for this long is frozen, or its machine is overloaded; it reports every
0.2 s.
"""
STUCK_S = 0.3
"""Age of the executor's last tick at which it counts as stuck; it ticks every 0.02 s, and the
reported age grows for up to one more period.
"""
LOOK_S = 0.03
"""Period of the watch; with `SILENT_S` it stays below the half second within which a fault is
reported.
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
_ADVICE: dict[str, str] = {
    "silent": "If it lasts, stop the module and start it again.",
    "stuck": "Stop the module and start it again.",
    "stalled": "See what it waits for, then stop it and start it again.",
    "failing": "Do what the message says. The module continues once the cause is gone.",
    "frozen": "Continue its process (kill -CONT), or start the module again.",
    "waiting": "Wait for it, or see to what is missing.",
    "fault": "Look at the robot; recover_robot clears the fault where its driver can.",
}
"""What to do, by the health of a module or the rule of its reason."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ModuleView:
    """State of one module at one instant.

    Attributes:
        kind, phase: its kind, and its phase in the supervisor.
        process: None if there is none; the ended process of a module that has ended by itself.
        plan, settings: the plan it was started with, and the settings of its process.
        report: its newest status, None before the first.
    """

    kind: ModuleKind
    phase: Phase
    process: ModuleProcess | None = None
    plan: Plan | None = None
    settings: ModuleSettings | None = None
    report: Report | None = None

    def health(self, now_s: float) -> Health:
        """Return the module's health; of several faults the one that explains the others.

        A module that does not report gives no other information; one whose executor hangs makes no
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

    def still_reason(self, now_s: float) -> StillReason | None:
        """Why nothing moves that needs the module; None if it works.

        Args:
            now_s: monotonic time [s].
        """
        if self.phase != "running":
            return not_running(
                self.kind, self.phase, self.process, f"Call start_{self.kind} first."
            )
        health, report = self.health(now_s), self.report
        rule: str = health
        message, hint = f"{self.kind} is {health}: {EXPLANATIONS[health]}.", ""
        if loss := self.loss():
            rule, message = "frozen", f"{self.kind} {loss}."
        elif health in ("ok", "waiting", "failing") and report is not None and report.fault:
            rule, message = "fault", f"The {self.kind} is stopped by a fault: {report.fault}."
        elif health == "failing" and report is not None:
            message, hint = f"{self.kind} reports: {report.error}", report.error_hint
        elif health == "waiting" and report is not None and report.waiting_for:
            message = f"{self.kind} waits for {report.waiting_for}."
        elif health == "ok":
            return None
        load = overload()
        if rule == "silent" and load:
            hint = f"T{load[1:]}: end what else runs on it. A restart of the module does not help."
        return StillReason(
            rank="module", rule=rule, message=message, hint=hint or _ADVICE.get(rule, "")
        )

    def loss(self) -> str:
        """Return why motion cannot rely on the module any more, as the predicate of a sentence
        about it; empty if it can, or if it is not to run.

        It has ended by itself, or the kernel has stopped its process (SIGSTOP, a debugger). Silence
        is none: on a busy machine reports came more than two seconds late.
        """
        process = self.process
        if process is None or self.phase not in ("running", "exited"):
            return ""
        if self.phase == "exited":
            return f"has ended by itself ({describe_exit(process.exit_code or 0)})"
        return "is frozen (SIGSTOP or a debugger)" if process.is_frozen() else ""


class Stopped(BaseModel):
    """Result of a stop: the process is gone from the process table, or its start was cancelled.

    Attributes:
        took_s: from the call until the process was reaped.
        report: the last one received.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    module: ModuleKind
    cancelled_start: bool = Field(default=False, description="it was still starting")
    pid: int | None = None
    exit_code: int | None = Field(default=None, description="negative for the signal that ended it")
    killed: bool = Field(default=False, description="it did not exit in time and was killed")
    took_s: float = 0.0
    report: SkipValidation[Report | None] = Field(default=None, exclude=True)


class Modules:
    """The modules of one server and their processes, with events for features.

    Args:
        log_directory: folder of the modules' logs, one file each.
        on_change: called from any thread, with the kind, when a module started, stopped or ended by
            itself.

    Attributes:
        changes: notified of every change of a module; its lock guards `slots`.
        slots: by kind; the first is that of the working module, the others are about to replace it
            or were replaced.
        log_directory: as given.
        process_events: events of module processes, for listeners.
        tightened: limits for new modules instead of the configured ones, or None; set by the
            feature that tightens limits.
        secret_variables: environment variables that are withheld from modules; features may add
            some.
    """

    def __init__(self, log_directory: Path, on_change: Callable[[ModuleKind], object]) -> None:
        self.log_directory = log_directory
        self.on_change = on_change
        self.process_events = ProcessEvents()
        self.tightened: LimitsConfig | None = None
        self.secret_variables: set[str] = set()
        self.changes = Changes()
        self.slots = {kind: [Slot(kind, self.changes)] for kind in MODULE_KINDS}
        self._endings = tuple(f"/{kind}" for kind in MODULE_KINDS)
        # process ids of all that was started, as text, which is how they come in a DiagnosticStatus
        self._ours: set[str] = set()
        self._foreign: dict[str, tuple[str, float]] = {}

    def add_kinds(self, kinds: Iterable[ModuleKind]) -> None:
        """Take modules of these kinds too, while the server is assembled; known ones stay."""
        with self.changes.lock:
            for kind in kinds:
                self.slots.setdefault(kind, [Slot(kind, self.changes)])
            self._endings = tuple(f"/{kind}" for kind in self.slots)

    def slot(self, kind: ModuleKind) -> Slot:
        """Slot of the module that works now. Do not keep it: a replacement changes it."""
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
        """Store a module's report.

        Args:
            status: from any node.
            now_s: monotonic time of its arrival.
        """
        name, pid = status.name, status.hardware_id
        if pid in self._ours:  # by any name: a standby's is not that of its kind
            values = {pair.key: pair.value for pair in status.values}
            report = Report.from_values(values, received_s=now_s)
            for slot in self.all_slots():
                slot.accept(name, pid, report)
        elif name.endswith(self._endings):
            self._foreign = dict(list(self._foreign.items())[-_FOREIGN:])
            self._foreign[name] = (pid, now_s)

    def foreign(self, name: str) -> str | None:
        """Process id of a foreign process that reported under `name` within the last second, or
        None.
        """
        with self.changes.lock:
            pid, seen_s = self._foreign.get(name, ("", 0.0))
        return pid if pid and time.monotonic() - seen_s < _FOREIGN_S else None

    def all_slots(self) -> list[Slot]:
        """Slots of every kind."""
        with self.changes.lock:
            return [slot for slots in self.slots.values() for slot in slots]

    def view(self, kind: ModuleKind) -> ModuleView:
        """State of a module now; consistent, because the lock is held."""
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

    def still_reasons(self, needed: Collection[ModuleKind]) -> list[StillReason]:
        """Why nothing moves because of modules: each of the `needed` ones that does not work, and
        every other one with a fault.
        """
        now_s = time.monotonic()
        reasons = [
            view.still_reason(now_s)
            for view in self.views()
            if view.kind in needed or view.health(now_s) in FAULTS
        ]
        return [reason for reason in reasons if reason is not None]

    def views(self) -> list[ModuleView]:
        """All modules, in the order robot, perception, inference, control, those of features."""
        return [self.view(kind) for kind in self.slots]

    def require_running(self, kind: ModuleKind) -> ModuleView:
        """Return the view of a running module.

        Raises:
            StateError: it is not running; the message says why and what to do.
        """
        with self.changes.lock:
            self.slot(kind).check_running(f"Call start_{kind} first.")
            return self.view(kind)


class Watch(Periodic):
    """Thread that checks all modules and reports every change of their health, and their events.

    Args:
        views: the modules.
        listener: called on the watching thread with the module, its previous health and its present
            one; must return quickly.
        on_event: called likewise with the module's kind, and the word and details of an event that
            it reports.
    """

    def __init__(
        self,
        views: Callable[[], Sequence[ModuleView]],
        listener: Callable[[ModuleView, Health, Health], object],
        on_event: Callable[[str, str, dict[str, str]], object] = lambda *event: None,
    ) -> None:
        super().__init__("watch", LOOK_S, self.look)
        self._views = views
        self._listener = listener
        self._on_event = on_event
        self._known: dict[str, Health] = {}
        self._events: dict[str, int] = {}

    def look(self) -> None:
        """Compare the health of all modules with the last known one."""
        now_s = time.monotonic()
        for view in self._views():
            self._note_event(view)
            health, before = view.health(now_s), self._known.get(view.kind, "stopped")
            if health == before:
                continue
            self._known[view.kind] = health
            level = logging.WARNING if health in FAULTS else logging.INFO
            log.log(level, "%s: %s (was %s): %s.", view.kind, health, before, EXPLANATIONS[health])
            self._listener(view, before, health)

    def _note_event(self, view: ModuleView) -> None:
        """Pass on a module's newest event, once; without a report the next process counts anew."""
        report = view.report
        count = 0 if report is None else report.event_count
        if report is not None and count > self._events.get(view.kind, 0):
            self._on_event(view.kind, report.event, {"explanation": report.event_text})
        self._events[view.kind] = count
