"""One place for one module: what is in it, and which change of it is allowed now."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Literal

from roboneuron.config import ModuleSettings
from roboneuron.errors import NotReadyError, StateError
from roboneuron.modules.report import Report
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.process import ModuleProcess

Phase = Literal["stopped", "starting", "running", "stopping", "exited"]
"""What is being done with a module, as the supervisor knows it: "exited" is what ended by itself.
"""


_NEXT: Mapping[str, str] = {
    "starting": "It is being started: wait for that; get_status tells how far it is.",
    "stopping": "It is being stopped: wait for that, then start it again.",
}
"""What to do about a module that does not run yet, or any more."""


class Slot:
    """The phases of one module; every change is made under the lock of `changes` and announced.

    A start goes from "stopped" or "exited" to "starting" and then to "running", or back to
    "stopped"; a stop from "running" to "stopping" and "stopped". Whoever begins one of them owns
    the slot until `settle`.

    Attributes:
        kind: of the module.
        phase: see above.
        process, plan, settings: what runs, or has ended by itself, what it was started with, and
            what its process was told; None when there is nothing.
        report: the newest that its process has made; None before the first.
        started_s: when it was last claimed for a start [monotonic s].
    """

    def __init__(self, kind: ModuleKind, changes: Changes) -> None:
        """Args:
        kind: of the module.
        changes: of the table that the slot is in.
        """
        self.kind = kind
        self.phase: Phase = "stopped"
        self.process: ModuleProcess | None = None
        self.plan: Plan | None = None
        self.settings: ModuleSettings | None = None
        self.report: Report | None = None
        self.started_s = 0.0
        self._cancelled = ""
        self._changes = changes

    def begin_start(self, plan: Plan, settings: ModuleSettings) -> None:
        """Claim the slot for a start.

        Args:
            plan: what is started.
            settings: what its process is told.

        Raises:
            StateError: something is in it; the message says what.
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
            self._cancelled = ""
        self._changes.notify()

    @property
    def stop_timeout_s(self) -> float:
        """Time that what is in it gets to leave [s]; 0 when there is nothing."""
        settings = self.settings
        return 0.0 if settings is None else settings.config.supervisor.stop_timeout_s

    def begin_stop(self) -> ModuleProcess:
        """Claim the slot for a stop: whoever gets the process ends it, and nobody else.

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
        """Keep a report if it is one of the process that is here.

        Args:
            status_name: under which it was reported; other servers' modules may have the same.
            pid: of the process that reported it: a predecessor may still do so.
            report: what it said.
        """
        process, settings = self.process, self.settings
        if process is None or settings is None or str(process.pid) != pid:
            return False
        if settings.status_name != status_name or self.phase == "exited":
            return False
        self.report = report
        return True

    def settle(self, phase: Phase) -> None:
        """A start or stop has come to its end.

        Args:
            phase: from now on; "stopped" forgets what ran.
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
        """End a start in progress; returns whether there was one.

        Whoever runs the start notices within 50 ms and ends the process; see `check_not_cancelled`.

        Args:
            reason: for whoever had asked for the start.
        """
        with self._changes.lock:
            starting = self.phase == "starting"
            if starting:
                self._cancelled = reason
        self._changes.notify()
        return starting

    def check_not_cancelled(self) -> None:
        """Do nothing unless the start in progress was cancelled.

        Raises:
            StateError: it was; says why.
        """
        if self._cancelled:
            raise StateError(f"The start of {self.kind} was cancelled: {self._cancelled}")

    def check_running(self, hint: str = "") -> None:
        """Raises StateError with the reason and `hint` unless the module runs."""
        if self.phase != "running":
            why = (
                f": {self.explain_exit()}" if self.phase == "exited" else f" (it is {self.phase})."
            )
            raise StateError(f"{self.kind} is not running{why}", hint=_NEXT.get(self.phase, hint))

    def check_alive(self, doing: str) -> None:
        """Raises NotReadyError when the process has ended, with its last words, or is frozen."""
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
                f"{_ending(process.exit_code)} while {doing}.",
                hint=f"Its last lines: {_quote(process.last_lines())} Whole log: "
                f"{process.log_path}",
            )

    def note_exit(self, process: ModuleProcess) -> bool:
        """The process ended; returns whether nobody had asked for that.

        Args:
            process: compared with what is here now: a new one may have taken its place.
        """
        with self._changes.lock:
            unexpected = self.process is process and self.phase == "running"
            if unexpected:
                # the last words of a dead process tell nothing of the present
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
        """How it ended by itself; empty when it did not."""
        process = self.process
        if self.phase != "exited" or process is None:
            return ""
        return (
            f"its process (pid {process.pid}) ended by itself with "
            f"{_ending(process.exit_code or 0)} at {process.ended_at.astimezone():%H:%M:%S}. "
            f"Last lines: {_quote(process.last_lines())}"
        )


def _ending(code: int) -> str:
    """An exit code in words; negative ones are signals, as subprocess tells them."""
    return f"exit code {code}" if code >= 0 else f"signal {-code}"


def _quote(lines: tuple[str, ...]) -> str:
    return " | ".join(line.strip() for line in lines if line.strip())[-1500:] or "(none)."
