"""The optional PIN of a release: required on every path, counted, delayed, audited, and stored only
as a hash.
"""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import time
from pathlib import Path

import pytest

from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.estop.pin import FILE_NAME as PIN_NAME
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate.audit import AuditLog

PIN = "4711-ruby"
PROMPTS = (b"none): ", b"Again: ", b"PIN: ", b"[y/N] ")


class Clock:
    """Wall-clock time that the test sets."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def pin(tmp_path: Path, clock: Clock) -> ReleasePin:
    made = ReleasePin(tmp_path, clock)
    made.set(PIN)
    return made


@pytest.fixture
def audit(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit.jsonl", time.time_ns)


def records(folder: Path) -> list[dict[str, str]]:
    return [json.loads(line) for line in (folder / "audit.jsonl").read_text().splitlines()]


def test_without_a_pin_nothing_is_asked(tmp_path: Path, audit: AuditLog) -> None:
    ReleasePin(tmp_path).check("", who="ann", audit=audit)


def test_the_file_holds_no_pin_and_is_private(pin: ReleasePin) -> None:
    assert PIN not in pin.path.read_text()
    assert pin.path.stat().st_mode & 0o777 == 0o600


def test_the_stop_stays_latched_without_the_pin(
    tmp_path: Path, pin: ReleasePin, audit: AuditLog
) -> None:
    latch = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns)
    latch.press(who="ann", reason="smoke")
    for wrong in ("", "4711"):
        with pytest.raises(RefusedError, match="stays latched"):
            latch.reset(who="agent", role="admin", audit=audit, pin=wrong)
    assert latch.is_latched()
    latch.reset(who="ann", role="admin", audit=audit, pin=PIN)
    assert not latch.is_latched()
    refused = [record for record in records(tmp_path) if record.get("rule") == "pin"]
    assert [record["who"] for record in refused] == ["agent", "agent"]
    assert "attempt 2" in refused[1]["reason"]
    assert PIN not in (tmp_path / "audit.jsonl").read_text()


def test_wrong_pins_delay_the_next_attempt_even_with_the_right_one(
    pin: ReleasePin, clock: Clock, audit: AuditLog, tmp_path: Path
) -> None:
    for _ in range(4):
        with pytest.raises(RefusedError, match="wrong"):
            pin.check("1234", who="agent", audit=audit)
    with pytest.raises(RefusedError, match="looked at in 2 s"):
        ReleasePin(tmp_path, clock).check(PIN, who="ann", audit=audit)  # in another process, too
    clock.now_s += 2.1
    pin.check(PIN, who="ann", audit=audit)
    with pytest.raises(RefusedError, match="attempt 1 "):
        pin.check("1234", who="agent", audit=audit)


def test_a_damaged_file_releases_nothing(pin: ReleasePin, audit: AuditLog) -> None:
    pin.path.write_text("{")
    with pytest.raises(RefusedError, match="cannot be read"):
        pin.check(PIN, who="ann", audit=audit)


def test_a_robot_of_a_fleet_uses_the_pin_of_the_fleet(
    tmp_path: Path, pin: ReleasePin, audit: AuditLog
) -> None:
    folder = tmp_path / "robots" / "left"
    folder.mkdir(parents=True)
    with pytest.raises(RefusedError):
        ReleasePin(folder).check("", who="agent", audit=audit)


def test_a_short_pin_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="3 characters"):
        ReleasePin(tmp_path).set("123")


def in_a_terminal(state: Path, *options: str, types: list[str]) -> tuple[int, str]:
    """Run in a terminal with `script -qec`, with an answer to each question."""
    person, terminal = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "estop",
        *options,
        "--state",
        str(state),
    ]
    process = subprocess.Popen(
        command,
        stdin=terminal,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # /dev/tty is not that of the test's own shell
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    told, answers = b"", list(types)
    try:
        while letter := process.stdout.read(1):
            told += letter
            if told.endswith(PROMPTS) and answers:
                os.write(person, f"{answers.pop(0)}\n".encode())
        return process.wait(60), told.decode()
    finally:
        process.kill()
        process.wait(10)
        process.stdout.close()
        os.close(person)
        os.close(terminal)


def test_a_faked_terminal_does_not_release_without_the_pin(tmp_path: Path) -> None:
    assert in_a_terminal(tmp_path, "--set-pin", types=[PIN, PIN])[0] == 0
    assert (tmp_path / PIN_NAME).exists()
    latch = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns)
    latch.press(who="ann", reason="smoke")
    code, told = in_a_terminal(tmp_path, "--reset", types=["y", "y"])
    assert code != 0
    assert "stays latched" in told
    assert latch.is_latched()
    code, told = in_a_terminal(tmp_path, "--reset", types=["y", PIN])
    assert (code, "Released." in told) == (0, True), told
    assert PIN not in told


def test_the_pin_is_changed_by_those_who_know_it(
    tmp_path: Path, pin: ReleasePin, audit: AuditLog
) -> None:
    code, told = in_a_terminal(tmp_path, "--set-pin", types=["wrong", "abcd", "abcd"])
    assert code != 0, told
    assert in_a_terminal(tmp_path, "--set-pin", types=[PIN, "abcdef", "abcdef"])[0] == 0
    ReleasePin(tmp_path).check("abcdef", who="ann", audit=audit)
    assert in_a_terminal(tmp_path, "--set-pin", types=["abcdef", "", ""])[0] == 0
    assert not ReleasePin(tmp_path).is_set
