"""End of a process whose interpreter hangs: one thread keeps the interpreter's lock, so that no
other runs, no signal is handled and no end of the parent is noticed.

A thread sets two timers of the kernel again and again. If it cannot, because the lock is kept, the
first one makes faulthandler write where every thread stands to the standard error, and the second
one ends the process with `END_SIGNAL`. Neither needs the lock, a thread or another process.

`faulthandler.dump_traceback_later(exit=True)` alone would end a process that was stopped (SIGSTOP,
a debugger) for longer than its bound, at the moment it goes on. The second timer therefore ends the
process only at its second expiry: a stopped process gets one signal, however long it was stopped,
and afterwards at most half of the bound to set the timers again; how much depends on when it goes
on, because the second timer keeps its phase. They follow CLOCK_MONOTONIC, which neither a suspended
machine nor a clock that is set advances. Source: timer_create(2), sigaction(2).

A process that gets little of a processor is no hang. The kernel cannot tell the two apart by a
timer, but a starved process is late before it is too late: the bound grows with how late the thread
was at its last settings, up to `MOST_BOUNDS` times, after which any process ends.
"""

from __future__ import annotations

import ctypes
import faulthandler
import logging
import os
import runpy
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

log = logging.getLogger(__name__)
VARIABLE = "ROBONEURON_HANG_TIMEOUT_S"
"""Environment variable with the bound [s], which processes hand on to those they start."""
DEFAULT_S = 15.0
"""Bound on a hang. The arm does not need it: modules hold after a silence of the server of 2 s
(`server_timeout_s`). With 85 runnable tasks on two cores, two of them threads of the same process,
a healthy thread was late by 3.6 s, and a process that was stopped has half of the bound.
"""
LOADING_S = 60.0
"""Bound while libraries and models are loaded and the ROS graph is joined. The dynamic loader keeps
the interpreter's lock while it reads a library of gigabytes from a cold disk, and the creation of a
ROS node kept it for over 3 s at 50 runnable tasks on two cores.
"""
END_SIGNAL = signal.SIGRTMAX - 1
"""Ends the process: a signal that nothing else uses tells a hang from other ends."""
_DUMP_SIGNAL = signal.SIGRTMAX - 2
_BEATS = 8
"""Settings of the timers within a bound; several may be late."""
_MOST_PERIOD_S = 1.0
MOST_BOUNDS = 4
"""Largest growth of the bound while the process gets little of a processor."""
_LATE_FACTOR = 8
"""Growth of the bound for each second of lateness, which varies much on an overloaded machine."""
_FORGET = 0.8
"""Share of an earlier lateness that counts at the next setting: a busy second is forgotten after
about ten.
"""
_SA_RESETHAND, _SA_RESTART, _SIGEV_THREAD_ID = 0x80000000, 0x10000000, 4


class _SigEvent(ctypes.Structure):
    """struct sigevent of Linux, 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("thread", ctypes.c_int),
        ("rest", ctypes.c_char * 44),
    )


class _SigAction(ctypes.Structure):
    """struct sigaction of glibc and musl on x86-64 and ARM64."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ulong * 16),
        ("flags", ctypes.c_uint),
        ("restorer", ctypes.c_void_p),
    )


class _Timer:
    """A timer of the kernel that sends a signal to the thread that makes it: what other threads
    wait for in the C library is not interrupted.
    """

    def __init__(self, libc: ctypes.PyDLL, number: int) -> None:
        """Raises:
        OSError: the kernel refuses.
        """
        self._libc = libc
        self._id = ctypes.c_void_p()
        tid = threading.get_native_id()
        event = _SigEvent(signal=number, notify=_SIGEV_THREAD_ID, thread=tid)
        _call(libc, "timer_create", time.CLOCK_MONOTONIC, ctypes.byref(event), self._ref())

    def _ref(self) -> object:
        return ctypes.byref(self._id)

    def set(self, first_s: float, again_s: float) -> None:
        """Expire after `first_s`, then every `again_s`; 0 for never."""
        parts = [part for s in (again_s, first_s) for part in (int(s), int(s % 1 * 1e9))]
        _call(self._libc, "timer_settime", self._id, 0, (ctypes.c_long * 4)(*parts), None)


def grown_bound_s(bound_s: float, late_s: float) -> float:
    """Bound [s] of a process whose watch was late by `late_s` at its last settings."""
    return min(bound_s + _LATE_FACTOR * late_s, MOST_BOUNDS * bound_s)


class HangWatch:
    """Watch of this process; `start` once, in the process that it watches (a forked one has
    neither its thread nor its timers).

    Usable from any thread. Without `start`, nothing is watched.
    """

    def __init__(self, bound_s: float | None = None) -> None:
        """Args:
        bound_s: longest hang [s]; by default that of the environment, else `DEFAULT_S`.
        """
        self._bound_s = bound_s or _given_s()
        self._loading = 0
        self._late_s = 0.0
        # guards the number of loading blocks, and that only one thread watches
        self._lock = threading.Lock()
        self._set: threading.Event | None = None

    def start(self) -> None:
        """Begin to watch; logs a warning where the system offers no such timers. Idempotent."""
        with self._lock:
            if self._set is not None:
                return
            self._set = threading.Event()
        threading.Thread(target=self._run, name="hang-watch", daemon=True).start()

    def bound(self, bound_s: float) -> None:
        """Set the bound [s] for this process and those that it starts."""
        os.environ[VARIABLE] = f"{bound_s:g}"
        self._bound_s = bound_s
        self._wake()

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Allow `LOADING_S` within the block, in which libraries or models are loaded."""
        self._count(1)
        try:
            yield
        finally:
            self._count(-1)

    def _count(self, change: int) -> None:
        with self._lock:
            self._loading += change
        self._wake()

    def _wake(self) -> None:
        if self._set is not None:
            self._set.set()

    def _now_s(self) -> float:
        bound_s = max(self._bound_s, LOADING_S) if self._loading else self._bound_s
        return grown_bound_s(bound_s, self._late_s)

    def _beat(self, libc: ctypes.PyDLL, dump: _Timer, end: _Timer) -> None:
        """Set everything anew: the first expiry writes the stacks and is otherwise without effect,
        the second one has the signal's default action.
        """
        half_s = self._now_s() / 2
        harmless = _SigAction(
            handler=ctypes.cast(libc.abs, ctypes.c_void_p).value,  # takes an int, does nothing
            flags=_SA_RESETHAND | _SA_RESTART,
        )
        _call(libc, "sigaction", int(END_SIGNAL), ctypes.byref(harmless), None)
        end.set(half_s, half_s)
        dump.set(half_s, 0.0)

    def _run(self) -> None:
        wake = self._set
        assert wake is not None
        try:
            # not CDLL, which would release the interpreter's lock for each of these short calls
            libc = ctypes.PyDLL(None, use_errno=True)
            dump, end = _Timer(libc, _DUMP_SIGNAL), _Timer(libc, END_SIGNAL)
            faulthandler.register(_DUMP_SIGNAL, file=2, all_threads=True)
            self._beat(libc, dump, end)
        except (OSError, AttributeError, ValueError, RuntimeError) as error:
            log.warning("A hang of this process would not be noticed: %s", error)
            return
        while True:
            begun_s, half_s = time.monotonic(), self._now_s() / 2
            period_s = min(2 * half_s / _BEATS, _MOST_PERIOD_S)
            wake.wait(period_s)
            wake.clear()
            took_s = time.monotonic() - begun_s
            # not more than the bound, or a long stop would be remembered for long
            late_s = min(took_s - period_s, self._bound_s)
            self._late_s = max(late_s, _FORGET * self._late_s)
            if took_s > half_s:
                log.warning("This process did nothing for %.1f s; the stacks are of then.", took_s)
            self._beat(libc, dump, end)


def main(words: list[str]) -> None:
    """Run a module as a program that is watched: `python -m roboneuron.hang_watch MODULE ...`.

    Args:
        words: name of the module, and its arguments.
    """
    HangWatch().start()
    sys.argv = words
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)


def _given_s() -> float:
    """Bound of the environment [s], if it is a positive number."""
    try:
        given_s = float(os.environ.get(VARIABLE, ""))
    except ValueError:
        return DEFAULT_S
    return given_s if 0 < given_s < float("inf") else DEFAULT_S


def _call(libc: ctypes.PyDLL, name: str, *arguments: object) -> None:
    """Call a function of the C library that returns 0. Raises OSError: it does not."""
    if getattr(libc, name)(*arguments) != 0:
        raise OSError(ctypes.get_errno(), f"{name} failed")


if __name__ == "__main__":
    main(sys.argv[1:])
