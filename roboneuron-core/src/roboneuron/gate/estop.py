"""The emergency stop as a latch in a file: while the file exists, nothing moves.

Existence is all that counts, so that checking costs one system call, a damaged file still stops, a person can stop with
`touch`, and the latch outlives every process. Whatever keeps it from being read counts as latched.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from roboneuron.errors import RefusedError, StateError, UnsafeError
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.request import ADMIN, has_role
from roboneuron.log_files import make_log_directory

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
        self._pressed: LatchState | None = None
        self._listeners: list[Callable[[], object]] = []

    def on_press(self, listener: Callable[[], object]) -> None:
        """Have `listener` called when this process presses the stop, before anything is written.

        It runs on the pressing thread, must return at once and must not raise: it wakes what moves.
        """
        self._listeners.append(listener)

    def is_latched(self) -> bool:
        """Whether motion is forbidden; about a microsecond."""
        if self._pressed is not None:
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
        if (pressed := self._pressed) is not None:
            return pressed
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
        """`press`, and have it outlive a loss of power; returns the first cause when it is latched already.

        Raises:
            UnsafeError: as `press`.
        """
        state = self.press(who=who, reason=reason)
        with suppress(OSError):  # it stops all the same
            self._sync()
        return state

    def press(self, *, who: str, reason: str) -> LatchState:
        """Forbid motion for every process; waits for no disk, so that it may be called where nothing may block.

        Raises:
            UnsafeError: the file cannot be created: only this process is stopped, the others do not know.
        """
        if self._pressed is None and self.is_latched():
            return self.read_state()
        state = LatchState(latched=True, who=who[:200], reason=reason[:500], time_ns=self._clock_ns())
        self._pressed = state  # this process stops at once, whatever the disk says
        for listener in self._listeners:
            listener()
        try:
            self._create(state)
        except OSError as error:
            raise UnsafeError(
                f"The emergency stop cannot be written to {self.path}: {error.strerror}; only this process is stopped.",
                hint="Use the robot's own stop.",
            ) from error
        self._pressed = None
        return state

    def _create(self, state: LatchState) -> None:
        """Make the file with its cause; the latch holds without it, and the cause that came first is kept."""
        make_log_directory(self.path.parent)
        try:
            descriptor = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644)
        except FileExistsError:
            return
        text = json.dumps({"who": state.who, "reason": state.reason, "time_ns": state.time_ns})
        try:
            with suppress(OSError):
                os.write(descriptor, text.encode())
        finally:
            os.close(descriptor)

    def _sync(self) -> None:
        descriptor = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        _sync_directory(self.path.parent)

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
        self._pressed = None


def _sync_directory(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
