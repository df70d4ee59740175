"""One module process: spawned in its own process group, reaped at once when it ends, killed with
its children.

The group stays in the server's session. So when the server dies, the kernel resumes a stopped
module with SIGHUP and SIGCONT, as every newly orphaned group (POSIX, `_exit`), and it exits. In a
session of its own it would stay frozen for ever and never handle its death signal.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from roboneuron.errors import NotReadyError
from roboneuron.hang_watch import END_SIGNAL
from roboneuron.log_files import escaped, opener, read_tail
from roboneuron.supervisor.changes import Event, Lasting

log = logging.getLogger(__name__)
_LAST_LINES = 15
"""Number of lines of a dead module's log in messages."""
KILL_S = 5.0
"""Timeout after SIGKILL; the kernel needs no more unless the process hangs in a driver."""
_LOOK_S = 0.1
"""Period of checking that a process whose end is waited for is not frozen."""
_FROZEN_S = 0.3
"""Minimum time for a stopped process to count as frozen: a debugger or job control may stop it
briefly.
"""


class ProcessEvents:
    """Events of module processes; listeners are called from any thread and must return quickly.

    Attributes:
        spawning: another process is about to be started.
        seen: the living process of that pid has passed its readiness check, or is about to be
            ended: inspect it now.
        ended: the process of that pid and name, and everything it had started, are dead; no other
            component was notified yet.
    """

    def __init__(self) -> None:
        self.spawning: Event[[]] = Event()
        self.seen: Event[[int]] = Event()
        self.ended: Event[[int, str]] = Event()


class ModuleProcess:
    """A running child process and, later, its end. Created by `spawn`; every method may be called
    from any thread.

    Attributes:
        ended_at: time of reaping; while it runs, time of the start.
    """

    def __init__(
        self,
        name: str,
        child: subprocess.Popen[bytes],
        log_path: Path,
        log_offset: int,
        events: ProcessEvents,
    ) -> None:
        """Args:
        name: name of its node.
        child: the running process; its stdin is a non-blocking pipe.
        log_path: file of its output.
        log_offset: start of its own output in that file [bytes].
        events: notified of its end.
        """
        self.name = name
        self.pid = child.pid
        self.log_path = log_path
        self.started_at = self.ended_at = datetime.now(UTC)
        self._child = child
        self._log_offset = log_offset
        # held while the process is signalled, written to or reaped: after that its pid and its pipe
        # may belong to another process
        self._reaping = threading.Lock()
        self._exited = threading.Event()
        self._events = events
        self._frozen = Lasting()

    @property
    def exit_code(self) -> int | None:
        """None while it runs; negative for the signal that ended it."""
        return self._child.returncode if self._exited.is_set() else None

    def is_frozen(self) -> bool:
        """True if it has been stopped (SIGSTOP, a debugger) for a while, so that it neither works
        nor answers.
        """
        try:
            stat = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8", errors="replace")
            state = stat.rpartition(")")[2].split()[0]  # the name before it may contain blanks
        except (OSError, IndexError):
            state = ""
        return self._frozen.held_s(state in ("T", "t")) > _FROZEN_S

    def last_lines(self) -> tuple[str, ...]:
        """Last lines that this process has written to its log."""
        return read_tail(self.log_path, lines=_LAST_LINES, offset=self._log_offset)

    def note(self, line: str) -> None:
        """Append a line to its log, so that it is among the last ones."""
        # a full disk costs the line, not the stop or start that it tells of
        with suppress(OSError), open(self.log_path, "a", encoding="utf-8", opener=opener) as file:
            file.write(f"{escaped(line)}\n")

    def show(self) -> None:
        """Let listeners inspect the process while it is alive."""
        self._events.seen.tell(self.pid)

    def beat(self) -> None:
        """Send a sign of life to the process; never blocks, and a process that does not read loses
        nothing.
        """
        self._write(b"\n")

    def announce(self, digest: bytes) -> None:
        """Announce a request of the server to the process before sending it; see
        `modules.requests`.

        Raises:
            NotReadyError: its pipe is full, because it has not read for a long time; it would
                refuse the request as foreign.
        """
        if not self._write(digest + b"\n"):
            raise NotReadyError(
                f"{self.name} (pid {self.pid}) does not read what its server tells it; it hangs."
            )

    def _write(self, line: bytes) -> bool:
        """Write the whole line, or return False if the pipe is full (POSIX: up to PIPE_BUF bytes
        are atomic).
        """
        with self._reaping, suppress(OSError):
            if self._child.returncode is None and self._child.stdin is not None:
                try:
                    os.write(self._child.stdin.fileno(), line)
                except BlockingIOError:
                    return False
        return True

    def terminate(self) -> None:
        """Send SIGTERM: the process holds the robot, releases its resources and exits. Does nothing
        after its end.
        """
        with self._reaping:
            self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL to the process and its group. Listeners inspect it before, because its
        resources cannot be found afterwards.
        """
        self.show()
        with self._reaping:
            if self._child.returncode is None:
                _kill_group(self.pid)
                self._signal(signal.SIGKILL)  # it leaves its group at its end

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal without Popen, which would reap an ended process, so that `reap` would wait
        for ever.
        """
        if self._child.returncode is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def wait(self, timeout_s: float) -> bool:
        """Return True if it ended, was reaped and cleaned up within `timeout_s`."""
        return self._exited.wait(timeout_s)

    def leaves(self, timeout_s: float) -> bool:
        """As `wait`, but False as soon as it is frozen, because it cannot end then."""
        end_s = time.monotonic() + timeout_s
        while not self.wait(min(_LOOK_S, max(0.0, end_s - time.monotonic()))):
            if self.is_frozen() or time.monotonic() >= end_s:
                return False
        return True

    def reap(self, on_exit: Callable[[ModuleProcess], None]) -> None:
        """Wait for its end on another thread; then kill the rest of its group, reap it, and call
        `on_exit`.
        """

        def watch() -> None:
            # Until it is reaped its pid cannot be reused: killing its group is safe.
            os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
            with self._reaping:
                _kill_group(self.pid)
                self._child.wait()
            if self._child.returncode == -END_SIGNAL:
                self.note(f"Process {self.pid} ended: its interpreter hung, with threads as above.")
            self.ended_at = datetime.now(UTC)
            if self._child.stdin is not None:
                with suppress(OSError):
                    self._child.stdin.close()
            self._events.ended.tell(self.pid, self.name)
            self._exited.set()
            on_exit(self)

        threading.Thread(target=watch, name=f"reaper-{self.name}", daemon=True).start()


def end_processes(processes: Sequence[ModuleProcess], timeout_s: float) -> set[int]:
    """Send SIGTERM, wait for a bounded time, send SIGKILL, reap; return the pids that had to be
    killed. A frozen process is not waited for, because it cannot handle SIGTERM.

    All processes get SIGTERM before the first wait, so that they exit in parallel, within one
    bound.

    Args:
        processes: to be ended; ended ones are ignored.
        timeout_s: from SIGTERM to SIGKILL [s].

    Raises:
        NotReadyError: one survives SIGKILL.
    """
    for process in processes:
        process.show()
        process.terminate()
    deadline_s = time.monotonic() + timeout_s
    killed = set()
    for process in processes:
        if not process.leaves(max(0.0, deadline_s - time.monotonic())):
            log.warning(
                "%s (pid %d) did not leave within %g s, or is frozen: killed.",
                process.name,
                process.pid,
                timeout_s,
            )
            process.kill()
            killed.add(process.pid)
    for process in processes:
        if not process.wait(KILL_S):
            raise NotReadyError(
                f"{process.name} (pid {process.pid}) survives SIGKILL: it hangs in the kernel."
            )
    return killed


def _kill_group(group: int) -> None:
    """Send SIGKILL to a process group; an empty or foreign one is left alone."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)


Command = Callable[[str | None], Sequence[str]]
"""Command line that starts a module process with an interpreter; None for the present one."""


def module_command(python: str | None) -> list[str]:
    """Return a `Command`'s result; `-P` keeps the working directory out of the import path."""
    return [python or sys.executable, "-u", "-P", "-m", "roboneuron.modules"]


def spawn(
    name: str,
    command: Sequence[str],
    environment: Mapping[str, str],
    first_line: str,
    log_path: Path,
    events: ProcessEvents,
) -> ModuleProcess:
    """Start `command`, write `first_line` to its stdin and keep that open; its output goes to
    `log_path`.

    Call it on a thread that lives as long as the server: PR_SET_PDEATHSIG follows the *thread*.

    Args:
        name: name of its node.
        command: command line with the interpreter.
        environment: the complete environment.
        first_line: without a line end.
        log_path: appended to.
        events: notified about the process.

    Raises:
        OSError: the command cannot be started.
    """
    events.spawning.tell()
    with open(log_path, "ab", opener=opener) as output:
        offset = output.tell()
        child = subprocess.Popen(  # runs until the module ends; ModuleProcess owns it
            list(command),
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=dict(environment),
            process_group=0,
        )
    assert child.stdin is not None
    # A child that dies before it reads is noticed by its reaper.
    with suppress(BrokenPipeError):
        child.stdin.write(first_line.encode() + b"\n\n")  # and a first sign of life
        child.stdin.flush()
    # from now on a module that does not read must never block the server
    os.set_blocking(child.stdin.fileno(), False)
    return ModuleProcess(name, child, log_path, offset, events)
