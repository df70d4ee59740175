"""How a module process ends: with its parent, however the parent dies, and by signals.

The parent's death is noticed in two independent ways: the kernel sends SIGTERM when the spawning
thread ends (PR_SET_PDEATHSIG), and stdin, a pipe whose other end only the parent holds, comes to
its end. Either way the module gets a bounded time to hold the robot and leave; after that the
kernel ends it, whatever its threads wait for. A module that is stopped (SIGSTOP) is woken by the
kernel, see `roboneuron.supervisor.process`.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

_PR_SET_PDEATHSIG = 1
"""Source: prctl(2)."""
GRACE_S = 1.5
"""Time between the parent's end and a hard exit."""
_ALARM_S = 0.3
"""The kernel's alarm comes so long after the exit that should have made it needless."""

_MOST_IN_A_PIPE = 2**20
"""Bytes, so that one read empties the pipe. Source: pipe(7), /proc/sys/fs/pipe-max-size."""


class Signals:
    """What signals have asked of the process, without a lock anywhere; main thread only, except
    `leave`.

    A handler runs in the middle of whatever the main thread does, another handler included: when a
    server is killed, the kernel sends the death signal again with the end of each of its threads.
    `threading.Event.set` holds a lock for a moment; interrupted there by a second signal, the main
    thread would wait for itself, for ever. Assigning an attribute cannot wait.

    Attributes:
        is_leaving: the module is to end.
    """

    def __init__(self) -> None:
        self.is_leaving = False
        self._stop_requested = False

    def listen(self) -> None:
        """From now on SIGTERM, SIGINT and SIGHUP end the module, and SIGUSR1 triggers the emergency
        stop.
        """
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: self.leave())
        signal.signal(signal.SIGUSR1, lambda *_: self._request_stop())

    def leave(self) -> None:
        """As if SIGTERM had come; from any thread."""
        self.is_leaving = True

    def take_stop(self) -> bool:
        """Whether the emergency stop was triggered since the last call."""
        requested = self._stop_requested
        # Only when it was set: a signal that comes just here is seen the next time, not lost.
        if requested:
            self._stop_requested = False
        return requested

    def _request_stop(self) -> None:
        self._stop_requested = True


class ParentPipe:
    """Stdin, whose other end only the parent holds; read by any thread that has to know what the
    parent has written.

    From now on descriptor 0 is the null device: a child that reads its stdin would take what is
    meant for this process.

    Args:
        on_data: gets what was read, in its order.
    """

    def __init__(self, on_data: Callable[[bytes], object]) -> None:
        self._on_data = on_data
        # held while reading and handing over, so that `on_data` gets the bytes in their order
        self._lock = threading.Lock()
        self._descriptor = os.dup(0)
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        os.close(null)

    def read(self) -> bool:
        """Read all that has been written until now; False when the parent's end is closed.

        When this returns, `on_data` has had every byte that was written before the call, whoever
        has read it.
        """
        with self._lock:
            if not select.select([self._descriptor], [], [], 0)[0]:
                return True
            data = os.read(self._descriptor, _MOST_IN_A_PIPE)
            if data:
                self._on_data(data)
        return bool(data)

    def read_to_the_end(self) -> None:
        """Return when the parent's end is closed."""
        while self.read():
            select.select([self._descriptor], [], [])


def follow_parent(expected_parent: int) -> None:
    """Ask the kernel for SIGTERM at the parent's death; exits at once when it is already gone.

    Args:
        expected_parent: process id of the parent, read first of all: a parent that dies before the
            kernel was asked sends no signal, and is noticed by another parent's number.

    Raises:
        OSError: the kernel refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != expected_parent:
        sys.exit("The parent process is gone.")


def end_group() -> None:
    """Kill all that plugins have started in this process's group; nobody else does when the server
    was killed.

    The process itself steps out first, into its parent's group; where there is no parent any more,
    it goes with them.
    """
    group = os.getpgrp()
    if group == os.getpid():
        with suppress(OSError):
            os.setpgid(0, os.getpgid(os.getppid()))
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)


def watch_stdin(
    on_end: Callable[[], None], on_beat: Callable[[bytes], object], grace_s: float = GRACE_S
) -> ParentPipe:
    """Call `on_beat` with what comes on stdin: the server lives.

    When stdin ends, call `on_end`, then leave the process the hard way after `grace_s` if it still
    runs. `on_end` may hang: by then SIGALRM is set, whose default action needs nobody's help.

    Args:
        on_end: asks the process to leave; called on the watching thread.
        on_beat: gets the bytes.
        grace_s: time to hold the robot and to release what was acquired [s].

    Returns:
        What this thread reads from; others may read too.
    """
    pipe = ParentPipe(on_beat)

    def watch() -> None:
        # The alarm comes after the exit below, and only if this thread is kept from that: by
        # `on_end`, or by somebody who holds the interpreter's lock.
        pipe.read_to_the_end()
        signal.setitimer(signal.ITIMER_REAL, grace_s + _ALARM_S)
        on_end()
        threading.Event().wait(grace_s)
        end_group()
        os._exit(3)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
    return pipe
