"""Signals in a burst, and a process that hangs at its end: nothing outlives its server."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.timeout(60)

LISTENS = """
import time
from roboneuron.modules.parent_watch import Signals
signals, presses, resumes = Signals(), 0, []
signals.on_resumed = lambda: resumes.append(1)
signals.listen()
print("listens", flush=True)
is_leaving = False
while not is_leaving:
    is_leaving = signals.is_leaving
    presses += signals.take_stop()
    time.sleep(0.001)
print(presses, len(resumes))
"""
HANGS = """
import threading
from roboneuron.modules.parent_watch import watch_stdin
watch_stdin(threading.Event().wait, print, grace_s=0.1)
print("waits", flush=True)
lock = threading.Lock()
lock.acquire()
lock.acquire()
"""


def python(script: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )
    assert process.stdout is not None
    process.stdout.readline()
    return process


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signals_that_interrupt_each_other_end_the_module_all_the_same(
    number: signal.Signals,
) -> None:
    """The kernel repeats the death signal at the end of each thread of the server."""
    for _ in range(5):
        with python(LISTENS) as process:
            deadline_s = time.monotonic() + 10.0
            while process.poll() is None and time.monotonic() < deadline_s:
                process.send_signal(number)
            ended = process.poll() is not None
            process.kill()
        assert ended, "told to end again and again, and did not"


def test_every_burst_of_presses_is_noticed_and_hinders_no_end() -> None:
    with python(LISTENS) as process:
        for _ in range(500):
            process.send_signal(signal.SIGUSR1)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=10.0)
    assert int(output.split()[0]) >= 1
    assert process.returncode == 0


def test_a_process_that_goes_on_after_it_was_frozen_knows_it() -> None:
    with python(LISTENS) as process:
        os.kill(process.pid, signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=10.0)
    assert output.split() == ["0", "1"]


def test_what_hangs_on_its_way_out_is_ended_by_the_kernel() -> None:
    with python(HANGS) as process:
        assert process.stdin is not None
        process.stdin.close()
        try:
            assert process.wait(10.0) == -signal.SIGALRM
        finally:
            process.kill()
