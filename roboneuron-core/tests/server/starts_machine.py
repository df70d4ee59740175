"""A supervisor without processes, for tests of stops and instructions."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

from roboneuron.errors import NotReadyError, StateError
from roboneuron.estop.motion_starts import MotionStarts
from roboneuron.modules.report import Report
from roboneuron.modules.settings import (
    INSTRUCTION_PARAMETER,
    MODULE_KINDS,
    START_PARAMETER,
    STOP_PARAMETER,
)
from roboneuron.supervisor.health import ModuleView

SILENCE_S = 2.0
"""The shorter `server_timeout_s` of robot and control."""


class Process:
    """A module that accepts parameters like a real one, unless it hangs."""

    def __init__(
        self, kind: str, pid: int, *, instruction: str = "", needs_start: str = ""
    ) -> None:
        self.kind, self.pid = kind, pid
        self.instruction, self.needs_start, self.stops = (
            instruction,
            needs_start,
            int(bool(needs_start)),
        )
        self.hangs = self.ended = self.frozen = False
        self.exit_code: int | None = None
        self.received_s = 0.0
        self.told: list[dict[str, Any]] = []

    @property
    def report(self) -> Report:
        return Report(
            received_s=self.received_s,
            instruction=self.instruction,
            needs_start=self.needs_start,
            stops=self.stops,
        )

    def is_frozen(self) -> bool:
        return self.frozen

    def stop(self, reason: str) -> None:
        self.needs_start, self.stops = reason, self.stops + 1

    def set(self, values: dict[str, Any], timeout_s: float, check: object = None) -> str:
        if self.hangs:
            raise NotReadyError("it hangs")
        self.told.append(values)
        if INSTRUCTION_PARAMETER in values:
            self.instruction = values[INSTRUCTION_PARAMETER]
        if STOP_PARAMETER in values:
            self.stop(values[STOP_PARAMETER])
            self.instruction = ""
        if START_PARAMETER in values:
            if values[START_PARAMETER] != self.stops:
                return "a stop came since"
            self.needs_start = ""
        return ""


class Slot:
    """Slot of a process that has just reported."""

    def __init__(self, process: Process) -> None:
        self.kind, self.phase, self.process = process.kind, "running", process

    @property
    def report(self) -> Report:
        return self.process.report

    def check_alive(self, doing: str) -> None:
        if self.process.frozen:
            raise NotReadyError(f"{self.kind} is frozen while {doing}.")


class Machine:
    """A supervisor with one process of each kind."""

    def __init__(self) -> None:
        self.needs_start, self.now_s = "", 0.0
        self.settings = cast(Any, SimpleNamespace(config=SimpleNamespace(silence_s=SILENCE_S)))
        self.changes = SimpleNamespace(
            lock=threading.RLock(), wait_for=lambda look, timeout_s: look()
        )
        self.slots: dict[str, list[Any]] = {
            kind: [Slot(Process(kind, 10 + number))] for number, kind in enumerate(MODULE_KINDS)
        }

    def pass_time(self, starts: MotionStarts, seconds: float, *silent: str) -> None:
        """Look as often as a busy server does, while the other modules report."""
        for _ in range(round(seconds / 0.1)):
            self.now_s += 0.1
            for kind in MODULE_KINDS:
                if kind not in silent:
                    self[kind].received_s = self.now_s
            starts.look(False)
            starts.settle()

    def __getitem__(self, kind: str) -> Process:
        return cast(Process, self.slots[kind][0].process)

    def views(self) -> list[ModuleView]:
        found = []
        for kind in MODULE_KINDS:
            slot = self.slots[kind][0]
            report = slot.process.report if slot.phase == "running" else None
            found.append(
                ModuleView(
                    kind=kind,
                    phase=slot.phase,
                    process=slot.process,
                    settings=self.settings,
                    report=report,
                )
            )
        return found

    def parameters(self, slot: Any) -> Process:
        return cast(Process, slot.process)

    def end(self, slot: Any) -> None:
        slot.process.ended, slot.phase = True, "stopped"

    def require_running(self, kind: str) -> None:
        raise StateError(f"{kind} is not running")
