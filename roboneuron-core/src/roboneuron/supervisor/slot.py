"""Slot for one module process: its content, and the changes allowed now."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Literal

from roboneuron.config import ModuleSettings
from roboneuron.errors import NotReadyError, StateError
from roboneuron.gate import StillReason
from roboneuron.hang_watch import END_SIGNAL
from roboneuron.modules.report import Report
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.process import ModuleProcess

Phase = Literal["stopped", "starting", "running", "stopping", "exited"]
"""Phase of a module in the supervisor; "exited" means that it ended by itself."""


_NEXT: Mapping[str, str] = {
    "starting": "It is being started: wait for that; get_status tells how far it is.",
    "stopping": "It is being stopped: wait for that, then start it again.",
    "exited": "Read its log (roboneuron logs), then start it again.",
}
"""Advice for a module that does not run."""


class Slot:
    """Phases of one module; every change is made under the lock of `changes` and announced.

    A start goes from "stopped" or "exited" to "starting" and then to "running", or back to
    "stopped"; a stop goes from "running" to "stopping" and "stopped". The caller that begins one of
    them owns the slot until `settle`.

    Attributes:
        kind: kind of the module.
        phase: see above.
        process, plan, settings: the process that runs or has ended by itself, its plan, and its
            settings; None if there is none.
        report: the newest report of the process; None before the first.
        started_s: time of the last claim for a start [monotonic s].
    """

    def __init__(self, kind: ModuleKind, changes: Changes) -> None:
        """Args:
        kind: kind of the module.
        changes: changes of the table that holds the slot.
        """
        self.kind = kind
        self.phase: Phase = "stopped"
        self.process: ModuleProcess | None = None
        self.plan: Plan | None = None
        self.settings: ModuleSettings | None = None
        self.report: Report | None = None
        self.started_s = 0.0
        self._cancelled = ""
        self._halt: threading.Event | None = None
        self._changes = changes

    def begin_start(
        self, plan: Plan, settings: ModuleSettings, halt: threading.Event | None = None
    ) -> None:
        """Claim the slot for a start.

        Args:
            plan: what is started.
            settings: settings for its process.
            halt: set when the client cancels its call, before the start as well.

        Raises:
            StateError: the slot is occupied; the message says by what.
        """
        with self._changes.lock:
            if self.phase not in ("stopped", "exited"):
                raise StateError(
                    f"{self.kind} is already {self.phase} ({self.describe()}).",
                    hint=f"Call stop_{self.kind} first"
                    + ("." if self.kind == "robot" else f", or switch_{self.kind}."),
                )
            self.phase, self.plan, self.settings = "starting", plan, settings
            self.started_s = time.monotonic()
            self.process = self.report = None
            self._cancelled, self._halt = "", halt
        self._changes.notify()

    @property
    def stop_timeout_s(self) -> float:
        """Time for the process in the slot to exit [s]; 0 if there is none."""
        settings = self.settings
        return 0.0 if settings is None else settings.config.supervisor.stop_timeout_s

    def begin_stop(self) -> ModuleProcess:
        """Claim the slot for a stop: only the caller that gets the process ends it.

        Raises:
            StateError: nothing is running.
        """
        with self._changes.lock:
            self.check_running()
            process = self.process
            assert process is not None
            self.phase = "stopping"
        self._changes.notify()
        return process

    def accept(self, status_name: str, pid: str, report: Report) -> bool:
        """Store a report if it comes from the process in this slot.

        Args:
            status_name: its status name; modules of other servers may have the same.
            pid: process id of the reporter: a predecessor may still report.
            report: the report.
        """
        process, settings = self.process, self.settings
        if process is None or settings is None or str(process.pid) != pid:
            return False
        if settings.status_name != status_name or self.phase == "exited":
            return False
        self.report = report
        return True

    def settle(self, phase: Phase) -> None:
        """Finish a start or stop.

        Args:
            phase: the new phase; "stopped" discards the process.
        """
        with self._changes.lock:
            self.phase = phase
            if phase == "stopped":
                self.process = self.plan = self.settings = self.report = None
        self._changes.notify()

    def await_settled(self, timeout_s: float) -> None:
        """Wait for the end of a start in progress, for at most `timeout_s`."""
        self._changes.wait_for(lambda: self.phase != "starting", timeout_s)

    def cancel(self, reason: str) -> bool:
        """Cancel a start in progress; return True if there was one.

        The starting thread notices within 50 ms and ends the process; see `check_not_cancelled`.

        Args:
            reason: for the caller that requested the start.
        """
        with self._changes.lock:
            starting = self.phase == "starting"
            if starting:
                self._cancelled = reason
        self._changes.notify()
        return starting

    def check_not_cancelled(self) -> None:
        """Raise if the start in progress was cancelled.

        Raises:
            StateError: it was; the message says why.
        """
        reason = self._cancelled
        if not reason and self._halt is not None and self._halt.is_set():
            reason = "its call was cancelled."
        if reason:
            raise StateError(f"The start of {self.kind} was cancelled: {reason}")

    def check_running(self, hint: str = "") -> None:
        """Raise StateError with the reason and `hint` unless the module runs."""
        if self.phase != "running":
            reason = not_running(self.kind, self.phase, self.process, hint)
            raise StateError(reason.message, hint=reason.hint)

    def check_alive(self, doing: str) -> None:
        """Raise NotReadyError if the process has ended, with its last words, or is frozen."""
        process = self.process
        if process is not None and process.exit_code is None and process.is_frozen():
            raise NotReadyError(
                f"The {self.kind} process (pid {process.pid}) is frozen (SIGSTOP or a debugger) "
                f"while {doing}.",
                hint=f"Continue it (kill -CONT {process.pid}), or start it again.",
            )
        if process is not None and process.exit_code is not None:
            raise NotReadyError(
                f"The {self.kind} process (pid {process.pid}) ended with "
                f"{describe_exit(process.exit_code)} while {doing}.",
                hint=f"Its last lines: {_quote(process.last_lines())} Whole log: "
                f"{process.log_path}",
            )

    def note_exit(self, process: ModuleProcess) -> bool:
        """Record the end of the process; return True if no stop was requested.

        Args:
            process: compared with the present one: a new process may have replaced it.
        """
        with self._changes.lock:
            unexpected = self.process is process and self.phase == "running"
            if unexpected:
                # the last report of a dead process says nothing about the present
                self.phase, self.report = "exited", None
        self._changes.notify()
        return unexpected

    def describe(self) -> str:
        """Pid, choices and start time, for messages."""
        parts = []
        if self.process is not None:
            parts.append(f"pid {self.process.pid}")
        if self.plan is not None:
            parts += [f"{key} {name!r}" for key, name in self.plan.names.items() if name]
        if self.process is not None:
            parts.append(f"since {self.process.started_at.astimezone():%H:%M:%S}")
        return ", ".join(parts) or "process not spawned yet"

    def explain_exit(self) -> str:
        """Explain how the process ended by itself; empty if it did not."""
        return _explain_exit(self.phase, self.process)


def not_running(
    kind: ModuleKind, phase: Phase, process: ModuleProcess | None, hint: str
) -> StillReason:
    """Why nothing moves that needs a module, which is in another phase than "running".

    Args:
        kind, phase, process: those of the module.
        hint: what to do if it is neither started nor stopped now.
    """
    why = f": {_explain_exit(phase, process)}" if phase == "exited" else f" (it is {phase})."
    return StillReason(
        rank="module",
        rule=phase,
        message=f"{kind} is not running{why}",
        hint=_NEXT.get(phase, hint),
    )


def _explain_exit(phase: Phase, process: ModuleProcess | None) -> str:
    if phase != "exited" or process is None:
        return ""
    return (
        f"its process (pid {process.pid}) ended by itself with "
        f"{describe_exit(process.exit_code or 0)} at {process.ended_at.astimezone():%H:%M:%S}. "
        f"Last lines: {_quote(process.last_lines())} Whole log: {process.log_path}"
    )


def describe_exit(code: int) -> str:
    """Describe an exit code; negative codes are signals, as in subprocess."""
    if code == -END_SIGNAL:
        return "a hang of its interpreter (its log says where its threads stood)"
    return f"exit code {code}" if code >= 0 else f"signal {-code}"


def _quote(lines: tuple[str, ...]) -> str:
    return " | ".join(line.strip() for line in lines if line.strip())[-1500:] or "(none)."
