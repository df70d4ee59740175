"""The emergency stop as a latch in a file: while the file exists, nothing moves.

Existence is all that counts, so that checking costs one system call, a damaged file still stops, a person can stop with
`touch`, and the latch outlives every process. Whatever keeps it from being read counts as latched.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from roboneuron.errors import RefusedError, StateError, UnsafeError
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.request import ADMIN, has_role

FILE_NAME = "emergency_stop.latched"
"""Name of the latch in the state directory."""
_MAX_BYTES = 4096


@dataclass(frozen=True, kw_only=True, slots=True)
class LatchState:
    """Who stopped and why; `time_ns` is wall-clock time [ns], 0 when the file does not tell."""

    latched: bool
    who: str = ""
    reason: str = ""
    time_ns: int = 0


class EmergencyStopLatch:
    """A latch shared by all processes that use the same file; safe from any thread. Construction touches nothing."""

    def __init__(self, path: Path, clock_ns: Callable[[], int]) -> None:
        """Args:
        path: the latch file; its directory is created when the stop is pressed.
        clock_ns: wall-clock time [ns].
        """
        self.path = path
        self._clock_ns = clock_ns
        self._unwritten = False

    def is_latched(self) -> bool:
        """Whether motion is forbidden; about a microsecond."""
        if self._unwritten:
            return True
        try:
            os.stat(self.path)
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def check(self) -> None:
        """Raise RefusedError while latched."""
        if self.is_latched():
            state = self.read_state()
            cause = f" by {state.who}: {state.reason}" if state.who else ""
            raise RefusedError(
                f"The emergency stop is latched{cause}. Nothing was sent.", hint="It has to be reset first."
            )

    def read_state(self) -> LatchState:
        """Who latched it and why, as far as the file tells."""
        if not self.is_latched():
            return LatchState(latched=False)
        try:
            with self.path.open(encoding="utf-8", errors="replace") as file:
                told = json.loads(file.read(_MAX_BYTES))
            return LatchState(
                latched=True, who=str(told["who"])[:200], reason=str(told["reason"])[:500], time_ns=int(told["time_ns"])
            )
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return LatchState(latched=True)

    def latch(self, *, who: str, reason: str) -> LatchState:
        """Forbid motion for every process; the first cause is kept when it is latched already.

        Raises:
            UnsafeError: the file cannot be created: only this process is stopped, the others do not know.
        """
        if self.is_latched() and not self._unwritten:
            return self.read_state()
        self._unwritten = True  # this process stops at once, whatever the disk says
        state = LatchState(latched=True, who=who[:200], reason=reason[:500], time_ns=self._clock_ns())
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(self.path, os.O_CREAT | os.O_WRONLY | os.O_CLOEXEC, 0o644))
        except OSError as error:
            raise UnsafeError(
                f"The emergency stop cannot be written to {self.path}: {error.strerror}; only this process is stopped.",
                hint="Use the robot's own stop.",
            ) from error
        self._unwritten = False
        self._write_cause(state)
        return state

    def _write_cause(self, state: LatchState) -> None:
        """Put the cause into the file, whole or not at all; the latch holds without it."""
        text = json.dumps({"who": state.who, "reason": state.reason, "time_ns": state.time_ns})
        temporary = self.path.with_name(f"{self.path.name}.{os.getpid()}.{threading.get_ident()}")
        try:
            with temporary.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self.path)
            _sync_directory(self.path.parent)
        except OSError:
            temporary.unlink(missing_ok=True)

    def reset(self, *, who: str, role: str, audit: AuditLog) -> None:
        """Allow motion again; nothing moves by itself.

        Args:
            who: which client.
            role: must be "admin".
            audit: gets the record first; without it there is no reset.

        Raises:
            RefusedError: the role has no right to, or the audit cannot be written.
            StateError: the latch cannot be removed; it stays latched.
        """
        allowed = has_role(role, ADMIN)
        record = AuditRecord(
            who=who,
            role=role,
            tool="reset_emergency_stop",
            verdict="allowed" if allowed else "refused",
            rule="" if allowed else "role",
        )
        audit.write(record)
        if not allowed:
            raise RefusedError(f"Resetting the emergency stop needs the role {ADMIN!r}, {who!r} has {role!r}.")
        try:
            self.path.unlink(missing_ok=True)
            if self.path.parent.is_dir():
                _sync_directory(self.path.parent)
        except OSError as error:
            raise StateError(f"The latch {self.path} cannot be removed: {error.strerror}; it stays latched.") from error
        self._unwritten = False


def _sync_directory(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
