"""A process that answers requests: its errors, its end, a freeze and a late answer are told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rn_testing.waiting import wait_until
from roboneuron import InvalidInputError, NotReadyError, answering_process
from roboneuron.answering_process import AnsweringProcess

WAYS = {
    "frozen": ("import os, signal; os.kill(os.getpid(), signal.SIGSTOP)", "is frozen"),
    "ended": ("import sys; sys.exit(3)", "has ended: status 3"),
    "silent": ("import time; time.sleep(60)", "did not answer in time"),
}


class Thing:
    """What a process holds."""

    def twice(self, value: object) -> object:
        return [value, value]

    def refuse(self) -> None:
        raise InvalidInputError("Not that.", hint="This.", path="it")

    def fail(self) -> None:
        raise ValueError("odd")

    def end(self, number: int) -> None:
        os.kill(os.getpid(), number)

    def pid(self) -> int:
        return os.getpid()

    def sleep(self) -> None:
        time.sleep(60.0)


@pytest.mark.parametrize("way", WAYS)
def test_a_process_that_is_lost_is_named(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, told = WAYS[way]
    monkeypatch.setattr(answering_process, "COMMAND", (sys.executable, "-S", "-c", program))
    process = AnsweringProcess("The thing", "nowhere:Thing")
    end_s = time.monotonic() + (0.5 if way == "silent" else 100.0)
    with pytest.raises(NotReadyError, match=told):
        process.ask("make", end_s=end_s)
    process.end()


def test_it_answers_with_values_and_errors() -> None:
    process = AnsweringProcess("The thing", f"{__name__}:Thing")
    end_s = time.monotonic() + 100.0
    try:
        large = np.zeros((2000, 2000, 3), np.uint8)  # more than a socket holds
        twice = process.ask("twice", large, end_s=end_s)
        assert isinstance(twice, list)
        np.testing.assert_array_equal(twice[1], large)
        with pytest.raises(InvalidInputError) as refused:
            process.ask("refuse", end_s=end_s)
        assert (refused.value.path, refused.value.hint) == ("it", "This.")
        with pytest.raises(NotReadyError, match="The thing failed: ValueError: odd"):
            process.ask("fail", end_s=end_s)
        assert process.is_alive
        with pytest.raises(NotReadyError, match="has ended: SIGKILL"):
            process.ask("end", int(signal.SIGKILL), end_s=end_s)
        wait_until(lambda: not process.is_alive, 5.0, "it is alive")
    finally:
        process.end()


def test_one_that_reads_nothing_is_ended_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture is larger than what a socket holds."""
    silent = (sys.executable, "-S", "-c", WAYS["silent"][0])
    monkeypatch.setattr(answering_process, "COMMAND", silent)
    process = AnsweringProcess("The thing", "nowhere:Thing")
    with pytest.raises(NotReadyError, match="in time"):
        process.ask("make", bytes(16 << 20), end_s=time.monotonic() + 0.3)
    assert not process.is_alive


def test_it_ends_with_its_parent_whatever_it_does() -> None:
    program = f"""
import os, sys, time
sys.path[:] = {sys.path!r}
from roboneuron.answering_process import AnsweringProcess
process = AnsweringProcess("The thing", "{__name__}:Thing")
end_s = time.monotonic() + 60.0
print(process.ask("pid", end_s=end_s), flush=True)
process.begin("sleep", end_s=end_s)
os._exit(0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=90, check=True
    )
    folder = Path("/proc") / done.stdout.strip()
    wait_until(lambda: not folder.exists(), 10.0, "it is alive")
