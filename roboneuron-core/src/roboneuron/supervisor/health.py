"""What modules say of themselves on /diagnostics, as typed reports."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from roboneuron.modules.report import StatusReport
from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.supervisor.changes import Changes

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

_KINDS = tuple(f"/{kind}" for kind in MODULE_KINDS)
_FOREIGN_S = 1.0
_FOREIGN = 64


@dataclass(frozen=True, kw_only=True)
class Report(StatusReport):
    """One module's newest status; `received_s` is the monotonic time of its arrival [s]."""

    received_s: float


class StatusBoard:
    """The newest report of each watched module process; every method may be called from any thread.

    Attributes:
        changes: told of every report.
    """

    def __init__(self, changes: Changes) -> None:
        self.changes = changes
        self._reports: dict[tuple[str, str], Report | None] = {}
        self._ours: set[str] = set()
        self._foreign: dict[str, tuple[str, float]] = {}

    def watch(self, name: str, pid: int) -> None:
        """Accept reports of the process `pid` under the status name `name`; those of anybody else are ignored."""
        with self.changes.lock:
            self._reports[name, str(pid)] = None
            self._ours.add(str(pid))

    def forget(self, name: str, pid: int) -> None:
        """Stop watching."""
        with self.changes.lock:
            self._reports.pop((name, str(pid)), None)

    def newest(self, name: str, pid: int) -> Report | None:
        """The newest report, or None before the first."""
        with self.changes.lock:
            return self._reports.get((name, str(pid)))

    def foreign(self, name: str) -> str | None:
        """Pid of a process of somebody else that reported under `name` within the last second, or None."""
        with self.changes.lock:
            pid, seen_s = self._foreign.get(name, ("", 0.0))
        return pid if pid and time.monotonic() - seen_s < _FOREIGN_S else None

    def receive(self, message: DiagnosticArray) -> None:
        """Subscription callback of /diagnostics."""
        now_s = time.monotonic()
        with self.changes.lock:
            for status in message.status:
                key = (status.name, status.hardware_id)
                if key in self._reports:
                    self._reports[key] = Report.from_values({v.key: v.value for v in status.values}, received_s=now_s)
                elif status.name.endswith(_KINDS) and status.hardware_id not in self._ours:
                    self._foreign = dict(list(self._foreign.items())[-_FOREIGN:])
                    self._foreign[status.name] = (status.hardware_id, now_s)
        self.changes.notify()
