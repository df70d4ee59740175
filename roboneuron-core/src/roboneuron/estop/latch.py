"""The emergency stop as a latch file: while the file exists, all motion is forbidden.

Only its existence counts. So checking costs one system call, a damaged file still stops, a person
can stop with `touch`, and the latch outlives every process. If the file cannot be checked, it
counts as latched.

A process that has seen the latch also keeps it in memory. Only a reset ends that: it renames the
file instead of removing it, which distinguishes a reset from a file that was deleted, moved or lost
with its directory. A lost file is written again, and counted.
"""

from __future__ import annotations

import errno
import logging
import os
import shlex
import stat
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from roboneuron.errors import RefusedError, StateError, UnsafeError
from roboneuron.estop.latch_file import (
    ESTOP_FILE,
    RESET_SUFFIX,
    LatchState,
    read_cause,
    sync,
    write_cause,
)
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog, AuditRecord, Role, StillReason
from roboneuron.log_files import make_log_directory

log = logging.getLogger(__name__)
_AGAIN_S = 1.0
"""Retry period for a latch that cannot be written."""


def latched_reason(cause: str) -> StillReason:
    """Why nothing moves while the stop is latched, by the origin of the stop; empty if unknown."""
    return StillReason(
        rank="stop",
        rule="emergency_stop",
        message=f"The emergency stop is latched{f' by {cause}' if cause else ''}.",
        hint="A person releases it: reset_emergency_stop, or `roboneuron estop --reset`.",
    )


class EmergencyStopLatch:
    """A latch shared by all processes that use the same file; thread-safe. Construction has no side
    effect.

    A process that must stay stopped even if the file is lost has to call `is_latched` periodically.

    Attributes:
        path: the latch file.
        on_press: called when this process triggers the stop, before anything is written or woken,
            on the triggering thread; must return at once and must not raise. It sends the commands
            that stop a robot.
        on_pressed: called after the file was written or could not be; must return at once and must
            not raise. It notifies others and wakes threads.
    """

    @classmethod
    def in_directory(cls, state: Path) -> EmergencyStopLatch:
        """Create the latch of a state directory with the system clock."""
        return cls(state / ESTOP_FILE, time.time_ns)

    def __init__(
        self, path: Path, clock_ns: Callable[[], int], clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        """Args:
        path: the latch file; its directory is created when the stop is triggered.
        clock_ns: wall-clock time [ns].
        clock_s: monotonic time [s].
        """
        self.path = path
        self._reset_path = path.with_name(path.name + RESET_SUFFIX)
        self._clock_ns = clock_ns
        self._clock_s = clock_s
        # State seen or set by this process: it stays stopped whatever happens to the file.
        self._held: LatchState | None = None
        # device and inode of the newest file that was seen
        self._seen: tuple[int, int] | None = None
        self._tried_s = -_AGAIN_S
        # a list, because `pop` gives a handle to one thread only
        self._spare: list[int] = []
        # Guards the state, over a few system calls at most. It is not held during listeners and
        # slow disk operations.
        self._lock = threading.RLock()
        self.on_press: list[Callable[[], object]] = []
        self.on_pressed: list[Callable[[], object]] = []

    def reserve(self) -> None:
        """Reserve a file handle for the latch file, so that a process without free handles can
        still stop the others.
        """
        with suppress(OSError):
            self._spare.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def release(self) -> bool:
        """Release the reserved handle; return True if there was one."""
        try:
            os.close(self._spare.pop())
        except IndexError:
            return False
        return True

    @property
    def release_command(self) -> str:
        """Command with which a person releases this stop, in a terminal on this machine. It names
        the directory, because that of another user or configuration differs.
        """
        return f"roboneuron estop --reset --state {shlex.quote(str(self.path.parent.absolute()))}"

    def is_latched(self) -> bool:
        """True if motion is forbidden; about 1 us."""
        with self._lock:
            try:
                self._seen = _identity_of(self.path)
            except FileNotFoundError:
                return self._held is not None and not self._was_reset()
            # a directory that cannot be entered, a failing disk: unknown counts as latched
            except OSError:
                return True
            if self._held is None:
                self._held = read_cause(self.path)
            return True

    def _was_reset(self) -> bool:
        """Check a missing file: True after a reset; otherwise it is written again."""
        with suppress(OSError):
            if self._seen is not None and _identity_of(self._reset_path) == self._seen:
                self._held = self._seen = None
                return True
        self._restore()
        return False

    def _restore(self) -> None:
        """Write the file again: at once if it has vanished, periodically if it could not be
        written.
        """
        has_vanished, now_s = self._seen is not None, self._clock_s()
        if self._held is None or (not has_vanished and now_s - self._tried_s < _AGAIN_S):
            return
        self._held = replace(self._held, restored=self._held.restored + has_vanished)
        self._seen, self._tried_s = None, now_s
        if has_vanished:
            log.error(
                "The emergency stop's file %s vanished without a reset: written again.", self.path
            )
        try:
            self._create(self._held)
        except OSError as error:
            log.error(
                "The emergency stop's file %s cannot be written: %s; latched here.",
                self.path,
                error.strerror,
            )

    def check(self, note: str = "") -> None:
        """Raise RefusedError if latched.

        Args:
            note: a sentence that follows the cause.

        Raises:
            RefusedError: it is latched; names the origin, as far as known.
        """
        if self.is_latched():
            raise latched_reason(self.read_state().cause).refusal(note)

    def still_reason(self) -> StillReason | None:
        """Why nothing moves while it is latched; None if it is not."""
        return latched_reason(self.read_state().cause) if self.is_latched() else None

    def read_state(self) -> LatchState:
        """Origin and reason, as far as the file contains them."""
        if not self.is_latched():
            return LatchState(latched=False)
        written, held = read_cause(self.path), self._held
        return written if written.who or held is None else held

    def latch(self, *, who: str, reason: str, audit: AuditLog | None = None) -> LatchState:
        """Trigger the stop, make it survive a power loss, and record it; return the first cause if
        already latched.

        Args:
            who: a client, person or signal.
            reason: may be empty.
            audit: gets a record if possible; the stop does not depend on it.

        Raises:
            UnsafeError: as `press`.
        """
        try:
            state = self.press(who=who, reason=reason)
            with suppress(OSError):  # the stop is in force all the same
                sync(self.path)
                sync(self.path.parent)
            return state
        finally:
            record = AuditRecord(
                who=who[:200],
                role="",
                tool="emergency_stop",
                verdict="latched",
                reason=reason[:500],
            )
            if audit is not None:
                audit.write_if_possible(record)

    def press(self, *, who: str, reason: str) -> LatchState:
        """Forbid motion for every process; does not wait for the disk, so that it may be called
        where blocking is forbidden.

        Args:
            who: a client, person or signal.
            reason: may be empty.

        Raises:
            UnsafeError: the file cannot be created: only this process is stopped, the others are
                not.
        """
        failures = self.press_together([self], who=who, reason=reason)
        if failures:
            raise failures[0]
        return self.read_state()

    @staticmethod
    def press_together(
        latches: Iterable[EmergencyStopLatch], *, who: str, reason: str
    ) -> list[UnsafeError]:
        """Call `press` for several latches, each step for all before the next; return the failures.

        The stop commands of all robots are sent before the first file is written, and all files are
        written before a thread is woken: each system call releases the GIL, and a woken thread may
        keep it for up to a millisecond.

        Args:
            latches: one per robot.
            who: a client, person or signal.
            reason: may be empty.
        """
        pressed: list[tuple[EmergencyStopLatch, LatchState]] = []
        failures: list[UnsafeError] = []
        for latch in latches:
            state = LatchState(
                latched=True, who=who[:200], reason=reason[:500], time_ns=latch._clock_ns()
            )
            if latch._hold(state):
                pressed.append((latch, state))
        for latch, _ in pressed:
            for listener in latch.on_press:
                listener()
        for latch, state in pressed:
            try:
                latch._create(state)
            except OSError as error:  # the others are written all the same; this one is tried again
                failure = UnsafeError(
                    f"The emergency stop cannot be written to {latch.path}: {error.strerror}; only "
                    "this process is stopped.",
                    hint="Use the robot's own stop.",
                )
                failure.__cause__ = error
                failures.append(failure)
        for latch, _ in pressed:
            for listener in latch.on_pressed:
                listener()
        return failures

    def _hold(self, state: LatchState) -> bool:
        """Stop this process at once, whatever the state of the disk; return False if the file is
        known to exist.
        """
        with self._lock:
            if self._held is not None and self.is_latched() and self._seen is not None:
                return False
            self._held, self._tried_s = state, self._clock_s()
        return True

    def _create(self, state: LatchState) -> None:
        """Create the file with its cause. The latch is in force without it, and the first cause is
        kept.
        """
        make_log_directory(self.path.parent)
        is_reserved = self.release()
        try:
            self._make_file(state)
        finally:
            if is_reserved:
                self.reserve()

    def _make_file(self, state: LatchState) -> None:
        """Create the file, then write the cause; the stop is in force from the creation on."""
        try:
            descriptor = os.open(
                self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644
            )
        except FileExistsError:
            with suppress(OSError):
                self._seen = _identity_of(self.path)
            return
        try:
            # of the created file, not of the one that has its name by now
            made = os.fstat(descriptor)
            self._seen = made.st_dev, made.st_ino
            # a full disk: the stop is in force without its cause
            with suppress(OSError):
                write_cause(descriptor, state)
        finally:
            os.close(descriptor)

    def reset(
        self,
        *,
        who: str,
        role: str,
        audit: AuditLog,
        pin: str = "",
        agreed_ns: int | None = None,
    ) -> None:
        """Release the latch; nothing moves by itself.

        Args:
            who: the client.
            role: must be "admin".
            audit: gets the record first; without it there is no reset.
            pin: PIN typed by a person, if one is set.
            agreed_ns: `time_ns` of the stop that the client saw; one pressed since is kept.

        Raises:
            RefusedError: the role is insufficient, the PIN is wrong, the audit cannot be
                written, or another stop was pressed since.
            StateError: the latch cannot be removed; it stays latched.
        """
        is_allowed = Role.ADMIN.is_held_by(role)
        if is_allowed:
            ReleasePin(self.path.parent).check(pin, who=who, audit=audit)
        audit.write(
            AuditRecord(
                who=who,
                role=role,
                tool="reset_emergency_stop",
                verdict="allowed" if is_allowed else "refused",
                rule="" if is_allowed else "role",
            )
        )
        Role.ADMIN.check(who, role, "Resetting the emergency stop")
        with self._lock:
            newest = self.read_state()
            is_other = agreed_ns is not None and newest.time_ns != agreed_ns
            if newest.latched and is_other:
                audit.write_if_possible(
                    AuditRecord(
                        who=who,
                        role=role,
                        tool="reset_emergency_stop",
                        verdict="refused",
                        rule="person",
                    )
                )
                raise RefusedError(
                    "The emergency stop was pressed again. It stays latched.",
                    hint="Look at the robot, then ask again.",
                    rule="person",
                )
            try:
                if newest.latched and self._seen is None:
                    # others detect the reset by the file only
                    self._create(self._held or LatchState(latched=True))
                with suppress(FileNotFoundError):
                    # the next reset could not replace it
                    if stat.S_ISDIR(os.lstat(self.path).st_mode):
                        raise IsADirectoryError(errno.EISDIR, "it is a directory")
                    # a rename keeps the inode, which distinguishes a reset from a loss
                    os.replace(self.path, self._reset_path)
                    sync(self.path.parent)
            except OSError as error:
                raise StateError(
                    f"The latch {self.path} cannot be removed: {error.strerror}; it stays latched."
                ) from error
            self._held = self._seen = None


def _identity_of(path: Path) -> tuple[int, int]:
    """Device and inode; a rename keeps them, a copy and a new file do not."""
    found = os.lstat(path)
    return found.st_dev, found.st_ino
