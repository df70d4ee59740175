"""A process in which one thread keeps the interpreter's lock: it ends within its bound, whatever it
is told meanwhile; one that only was stopped, is busy or loads goes on.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rn_testing.waiting import wait_until
from roboneuron.hang_watch import END_SIGNAL, VARIABLE, grown_bound_s

pytestmark = pytest.mark.timeout(60)
BOUND_S = 0.8
SOON_S = 20.0
BEGIN = """
import ctypes, os, signal, sys, threading, time
from roboneuron.hang_watch import HangWatch
from roboneuron.modules.parent_watch import Signals, watch_stdin
signals = Signals()
signals.listen()
watch_stdin(signals.leave, lambda data: data and say("goes on"), grace_s=0.5)
watch = HangWatch()
watch.start()
libc = ctypes.PyDLL(None)  # keeps the lock
def say(word):
    os.write(1, word.encode() + b"\\n")
def hang():
    sleep = libc.sleep
    say("ready")
    sleep(100)
"""
HANG = BEGIN + "threading.Thread(target=hang, daemon=True).start(); time.sleep(100)"
WAIT = BEGIN + "say('ready')\nwhile not signals.is_leaving: time.sleep(0.01)\nsay('left')"


@contextmanager
def process(script: str, bound_s: float = BOUND_S) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, VARIABLE: f"{bound_s}"},
    ) as child:
        assert child.stdout is not None
        try:
            assert child.stdout.readline() == b"ready\n"
            yield child
        finally:
            child.kill()


def finish(child: subprocess.Popen[bytes]) -> tuple[bytes, bytes]:
    """What it still writes to its output and its log until it has ended; stdin stays as it is."""
    assert child.stdout is not None
    assert child.stderr is not None
    output, log = child.stdout.read(), child.stderr.read()
    child.wait(SOON_S)
    return output, log


@pytest.mark.parametrize(
    "told",
    [
        "nothing",
        "SIGTERM",
        "end of stdin",
        pytest.param("SIGINT", marks=pytest.mark.exhaustive),
        pytest.param("SIGUSR1", marks=pytest.mark.exhaustive),
    ],
)
def test_it_ends_within_its_bound_and_says_where_its_threads_stood(told: str) -> None:
    begun_s = time.monotonic()
    with process(HANG) as child:
        if told == "end of stdin":
            assert child.stdin is not None
            child.stdin.close()
        elif told != "nothing":
            child.send_signal(signal.Signals[told])
        _, log = finish(child)
        assert child.returncode == -END_SIGNAL
        assert time.monotonic() - begun_s < SOON_S
        assert b"in hang" in log, log
        assert b"most recent call first" in log


def test_it_ends_when_its_parent_has_died() -> None:
    parent = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {HANG!r}], stdin=subprocess.PIPE, stdout=2)
print(child.pid, flush=True)
sys.stdin.read()
"""
    with subprocess.Popen(
        [sys.executable, "-c", parent],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, VARIABLE: f"{BOUND_S}"},
    ) as made:
        assert made.stdout is not None
        assert made.stderr is not None
        pid = int(made.stdout.readline())
        assert made.stderr.readline() == b"ready\n"
        made.kill()
        # the last holder of this pipe is the child: it is read to its end when the child is gone
        made.stderr.read()
    assert pid > 0


@pytest.mark.exhaustive  # half of the short bound is little time on a busy machine
def test_a_stopped_process_goes_on_however_long_it_was_stopped() -> None:
    """SIGSTOP, a debugger or a closed laptop is no hang; neither are two stops in a row."""
    with process(WAIT) as child:
        for stop in range(2):
            if stop:  # a stop before the timers are set again would count as one hang
                again_s = time.monotonic() + BOUND_S / 2
                wait_until(lambda end_s=again_s: time.monotonic() > end_s, SOON_S, "")  # type: ignore[misc]
            child.send_signal(signal.SIGSTOP)
            ended_s = time.monotonic() + 1.7 * BOUND_S
            # the stop has to last: nothing can be waited for in a stopped process
            wait_until(lambda end_s=ended_s: time.monotonic() > end_s, SOON_S, "")  # type: ignore[misc]
            child.send_signal(signal.SIGCONT)
            assert child.stdin is not None
            child.stdin.write(b"x\n")
            child.stdin.flush()
            assert child.stdout is not None
            assert child.stdout.readline() == b"goes on\n"
        child.send_signal(signal.SIGTERM)
        output, log = finish(child)
        assert (child.returncode, output) == (0, b"left\n"), log


def test_a_short_hang_and_one_while_loading_are_allowed() -> None:
    script = (
        BEGIN
        + f"say('ready'); libc.usleep({int(BOUND_S * 0.3e6)})\n"
        + f"with watch.loading(): time.sleep(0.1); libc.usleep({int(BOUND_S * 2e6)})"
        + "\ntime.sleep(0.1); say('left')"
    )
    with process(script) as child:
        output, log = finish(child)
        assert (child.returncode, output) == (0, b"left\n"), log


LONG_S = 2.0
"""Bound with which a busy machine makes little difference."""
LATER_AND_LATER = (
    "".join(
        f"libc.usleep({int(LONG_S * share * 1e6)}); time.sleep(0.3)\n"
        for share in (0.25, 0.5, 1.25, 1.75)
    )
    + "say('late')\n"
)
"""As seen by the thread of the watch, every thread gets less and less of a processor."""


@pytest.mark.exhaustive
def test_a_process_that_gets_little_of_a_processor_goes_on() -> None:
    with process(BEGIN + "say('ready')\n" + LATER_AND_LATER, LONG_S) as child:
        output, log = finish(child)
        assert (child.returncode, output) == (0, b"late\n"), log


@pytest.mark.exhaustive
def test_a_process_that_gets_little_of_a_processor_ends_when_it_hangs() -> None:
    with process(BEGIN + "say('ready')\n" + LATER_AND_LATER + "libc.sleep(100)", LONG_S) as child:
        output, log = finish(child)
        assert (child.returncode, output) == (-END_SIGNAL, b"late\n"), log


@pytest.mark.parametrize(
    ("late_s", "grown_s"), [(0.0, 15.0), (0.5, 19.0), (3.6, 43.8), (15.0, 60.0), (1e9, 60.0)]
)
def test_the_bound_grows_with_the_lateness_up_to_a_limit(late_s: float, grown_s: float) -> None:
    assert grown_bound_s(15.0, late_s) == pytest.approx(grown_s)


def test_after_loading_the_bound_holds_again() -> None:
    script = "\nwith watch.loading(): pass\nthreading.Thread(target=hang).start()"
    with process(BEGIN + script) as child:
        finish(child)
        assert child.returncode == -END_SIGNAL


@pytest.mark.exhaustive
def test_busy_threads_are_no_hang() -> None:
    """They give the lock away after each switch interval."""
    script = (
        BEGIN
        + "def busy():\n    end = time.monotonic() + 6.0\n"
        + "    while time.monotonic() < end: sum(range(1000))\n"
        + "threads = [threading.Thread(target=busy) for _ in range(8)]\n"
        + "say('ready')\n[t.start() for t in threads]; [t.join() for t in threads]; say('left')"
    )
    with process(script, 5.0) as child:
        output, log = finish(child)
        assert (child.returncode, output) == (0, b"left\n"), log


def test_what_it_starts_gets_its_bound_and_neither_its_timers_nor_handlers() -> None:
    script = (
        BEGIN
        + "watch.bound(77)\nimport subprocess\nsay('ready')\n"
        + "code = 'import os, signal; from roboneuron import hang_watch as h; '\n"
        + "code += 'print(os.environ[h.VARIABLE], signal.getsignal(h.END_SIGNAL).name)'\n"
        + "say(subprocess.check_output([sys.executable, '-c', code]).decode().strip())"
    )
    with process(script) as child:
        output, log = finish(child)
        assert output == b"77 SIG_DFL\n", log
