"""Termination of a module process: with its parent, in whatever way that dies, and by signals.

The parent's death is noticed in two independent ways: the kernel sends SIGTERM when the spawning
thread ends (PR_SET_PDEATHSIG), and stdin, a pipe whose other end only the parent holds, is closed.
Either way the module gets a bounded time to hold the robot and exit. After that the kernel ends it,
even if its threads hang. A module that is stopped (SIGSTOP) is resumed by the kernel, see
`roboneuron.supervisor.process`.
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
"""Delay of the kernel's alarm after the regular hard exit, for the case that this fails."""

_MOST_IN_A_PIPE = 2**20
"""Bytes, so that one read empties the pipe. Source: pipe(7), /proc/sys/fs/pipe-max-size."""


class Signals:
    """Requests received by signals, stored without any lock; main thread only, except `leave`.

    A handler interrupts the main thread anywhere, also inside another handler: when a server is
    killed, the kernel sends the death signal again with the end of each of its threads.
    `threading.Event.set` holds a lock for a moment; if a second signal interrupted it there, the
    main thread would deadlock. Assigning an attribute cannot block.

    Attributes:
        is_leaving: the module has to exit.
        on_resumed: called in the handler of SIGCONT; must take no lock.
    """

    def __init__(self) -> None:
        self.is_leaving = False
        self.on_resumed: Callable[[], None] = lambda: None
        self._stop_requested = False

    def listen(self) -> None:
        """Install the handlers: SIGTERM, SIGINT and SIGHUP end the module, SIGUSR1 triggers the
        emergency stop, SIGCONT tells that the process was stopped.
        """
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: self.leave())
        signal.signal(signal.SIGUSR1, lambda *_: self._request_stop())
        signal.signal(signal.SIGCONT, lambda *_: self.on_resumed())

    def leave(self) -> None:
        """Request the exit as SIGTERM does; from any thread."""
        self.is_leaving = True

    def take_stop(self) -> bool:
        """True if the emergency stop was triggered since the last call."""
        requested = self._stop_requested
        # Only when it was set: a signal that arrives here is seen by the next call, not lost.
        if requested:
            self._stop_requested = False
        return requested

    def _request_stop(self) -> None:
        self._stop_requested = True


class ParentPipe:
    """Stdin, whose other end only the parent holds; any thread may read it.

    Descriptor 0 becomes the null device: a child that reads its stdin would take data meant for
    this process.

    Args:
        on_data: called with the data in the order of the pipe.
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
        """Read everything written so far; return False when the parent's end is closed.

        On return, `on_data` has received every byte that was written before the call, whichever
        thread read it.
        """
        with self._lock:
            if not select.select([self._descriptor], [], [], 0)[0]:
                return True
            data = os.read(self._descriptor, _MOST_IN_A_PIPE)
            if data:
                self._on_data(data)
        return bool(data)

    def read_to_the_end(self) -> None:
        """Block until the parent's end is closed."""
        while self.read():
            select.select([self._descriptor], [], [])


def follow_parent(expected_parent: int) -> None:
    """Ask the kernel for SIGTERM at the parent's death; exit at once if the parent is already dead.

    Args:
        expected_parent: process id of the parent, read first of all. A parent that dies before the
            kernel was asked sends no signal; it is noticed by the changed parent id.

    Raises:
        OSError: the kernel refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != expected_parent:
        sys.exit("The parent process is gone.")


def end_group() -> None:
    """Kill all processes that plugins have started in this process's group; needed when the server
    was killed.

    The process first moves itself into its parent's group. Without a parent it is killed as well.
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
    """Call `on_beat` with data from stdin, which shows that the server is alive.

    When stdin is closed, call `on_end`, and exit hard after `grace_s` if the process still runs.
    `on_end` may hang: SIGALRM is set before, and its default action needs no thread of the process.

    Args:
        on_end: asks the process to exit; called on the watching thread.
        on_beat: gets the bytes.
        grace_s: time to hold the robot and to release resources [s].

    Returns:
        The pipe that this thread reads from; others may read too.
    """
    pipe = ParentPipe(on_beat)

    def watch() -> None:
        # The alarm comes after the exit below, and only if this thread is kept from that: by
        # `on_end`, or by a thread that holds the interpreter's lock.
        pipe.read_to_the_end()
        signal.setitimer(signal.ITIMER_REAL, grace_s + _ALARM_S)
        on_end()
        threading.Event().wait(grace_s)
        end_group()
        os._exit(3)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
    return pipe
