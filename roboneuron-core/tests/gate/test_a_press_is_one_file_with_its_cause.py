"""Content and permissions of the latch's file, records, notifications, and errors of the disk."""

from __future__ import annotations

import errno
import json
import os
import resource
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from standing_latch import NOWHERE, TIME_NS, a_latch

from roboneuron.errors import RefusedError, UnsafeError
from roboneuron.estop import EmergencyStopLatch, LatchState
from roboneuron.gate import AuditLog, AuditRecord

CAUSE = """
import sys, time
from pathlib import Path
from roboneuron.estop import EmergencyStopLatch
print(ascii(EmergencyStopLatch(Path(sys.argv[1]), time.time_ns).read_state().who))
"""


@pytest.fixture
def latch(tmp_path: Path) -> EmergencyStopLatch:
    return a_latch(tmp_path / "state" / "stop")


@pytest.fixture
def audit(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit", lambda: TIME_NS)


@contextmanager
def no_more(limit: int, least: int) -> Iterator[None]:
    """Lower a limit of this process, such as open files or file size, to `least`."""
    soft, hard = resource.getrlimit(limit)
    resource.setrlimit(limit, (least, hard))
    try:
        yield
    finally:
        resource.setrlimit(limit, (soft, hard))


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def make_by_hand(path: Path, content: bytes) -> EmergencyStopLatch:
    path.parent.mkdir()
    path.write_bytes(content)
    return a_latch(path)


# Writing and reading


def test_the_file_tells_who_and_why_and_when_and_everybody_may_read_it(latch) -> None:
    before = os.umask(0)
    try:
        latch.press(who="ann", reason="smoke")
    finally:
        os.umask(before)
    told = json.loads(latch.path.read_text())
    assert told == {"who": "ann", "reason": "smoke", "time_ns": TIME_NS, "restored": 0}
    assert stat.S_IMODE(latch.path.stat().st_mode) == 0o644
    assert stat.S_IMODE(latch.path.parent.stat().st_mode) == 0o750


def test_the_cause_is_cut_at_200_and_500_characters(latch, audit, records) -> None:
    latch.latch(who="w" * 201, reason="r" * 501, audit=audit)
    told = json.loads(latch.path.read_text())
    assert (told["who"], told["reason"]) == ("w" * 200, "r" * 500)
    assert (records[0].who, records[0].reason) == ("w" * 200, "r" * 500)


def test_a_cause_in_any_script_reaches_the_other_processes(latch) -> None:
    """JSON uses 12 characters for each of these."""
    latch.press(who="\U0001f6d1" * 200, reason="\U0001f525" * 500)
    found = a_latch(latch.path).read_state()
    assert (found.who, found.reason) == ("\U0001f6d1" * 200, "\U0001f525" * 500)


def test_a_cause_that_a_person_has_written_is_cut_too_and_was_never_restored(
    tmp_path: Path,
) -> None:
    told = json.dumps({"who": "w" * 300, "reason": "r" * 600, "time_ns": 5})
    found = make_by_hand(tmp_path / "state" / "stop", told.encode()).read_state()
    assert found == LatchState(latched=True, who="w" * 200, reason="r" * 500, time_ns=5, restored=0)


def test_a_cause_in_another_encoding_is_told_as_far_as_it_can_be_read(tmp_path: Path) -> None:
    told = '{"who": "Jürgen", "reason": "", "time_ns": 5}'.encode("latin-1")
    assert make_by_hand(tmp_path / "state" / "stop", told).read_state().who == "J\ufffdrgen"


def test_a_cause_is_read_as_utf_8_in_whatever_locale(latch) -> None:
    found = make_by_hand(latch.path, '{"who": "Jürgen", "reason": "", "time_ns": 5}'.encode())
    assert found.read_state().who == "Jürgen"
    plain = {**os.environ, "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-c", CAUSE, str(latch.path)],
        env=plain,
        timeout=60,
        check=True,
        capture_output=True,
    )
    assert done.stdout.decode().strip() == r"'J\xfcrgen'"


@pytest.mark.parametrize(
    ("spaces", "who"), [(0, "ann"), (1, "")], ids=["16384 characters", "one more"]
)
def test_a_file_without_end_costs_no_more_than_its_beginning(
    tmp_path: Path, spaces: int, who: str
) -> None:
    told = '{"who": "ann", "reason": "", "time_ns": 5'
    content = told + " " * (16_384 - len(told) - 1 + spaces) + "}"
    assert make_by_hand(tmp_path / "state" / "stop", content.encode()).read_state().who == who


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b'{"who": 1}', b'{"who": "a", "reason": "", "time_ns": Infinity}', b"[" * 10_000],
    ids=["empty", "list", "no reason", "endless time", "deep"],
)
def test_a_damaged_file_is_a_latch_without_a_cause(tmp_path: Path, content: bytes) -> None:
    latch = make_by_hand(tmp_path / "state" / "stop", content)
    assert latch.is_latched()
    assert latch.read_state() == LatchState(latched=True)
    with pytest.raises(RefusedError) as refused:
        latch.check()
    assert refused.value.message == "The emergency stop is latched."


def test_a_file_that_is_damaged_later_hides_no_cause_that_is_known(latch) -> None:
    latch.press(who="ann", reason="smoke")
    latch.path.write_bytes(b"")
    assert latch.read_state().cause == 'ann: "smoke"'
    assert a_latch(latch.path).read_state() == LatchState(latched=True)


def test_what_cannot_be_read_is_a_latch_without_a_cause(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert a_latch(tmp_path / "file" / "stop").read_state() == LatchState(latched=True)


@pytest.mark.parametrize(
    ("who", "reason", "cause"),
    [("ann", "smoke", ' by ann: "smoke"'), ("ann", "", " by ann"), ("", "smoke", ""), ("", "", "")],
)
def test_a_refusal_names_the_cause_and_then_what_the_caller_adds(
    latch, who: str, reason: str, cause: str
) -> None:
    assert latch.read_state() == LatchState(latched=False)
    latch.press(who=who, reason=reason)
    with pytest.raises(RefusedError) as refused:
        latch.check()
    assert refused.value.message == f"The emergency stop is latched{cause}."
    with pytest.raises(RefusedError) as refused:
        latch.check(" Hands off.")
    assert refused.value.message == f"The emergency stop is latched{cause}. Hands off."


# Records, and data on the disk


def test_a_latch_is_on_the_disk_and_recorded_when_it_returns(latch, audit, records, synced) -> None:
    state = latch.latch(who="ann", reason="smoke", audit=audit)
    assert state == LatchState(latched=True, who="ann", reason="smoke", time_ns=TIME_NS)
    assert synced == [str(latch.path), str(latch.path.parent)]
    expected = AuditRecord(
        who="ann", role="", tool="emergency_stop", verdict="latched", reason="smoke"
    )
    assert records == [expected]


def test_a_latch_that_cannot_be_written_is_recorded_all_the_same(audit, records) -> None:
    latch = a_latch(NOWHERE)
    with pytest.raises(UnsafeError):
        latch.latch(who="ann", reason="smoke", audit=audit)
    assert [record.verdict for record in records] == ["latched"]
    assert latch.read_state() == LatchState(
        latched=True, who="ann", reason="smoke", time_ns=TIME_NS
    )


def test_a_disk_that_does_not_sync_stops_no_stop(latch, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    assert latch.latch(who="ann", reason="smoke").who == "ann"


def test_a_full_disk_still_holds_the_latch_without_its_cause(latch) -> None:
    with no_more(resource.RLIMIT_FSIZE, 0):
        assert EmergencyStopLatch.press_together([latch], who="ann", reason="smoke") == []
    assert latch.path.read_bytes() == b""
    assert a_latch(latch.path).is_latched()


def test_pressing_and_resetting_leave_no_descriptor_open(latch, audit) -> None:
    audit.write(AuditRecord(who="", role="", tool="", verdict=""))
    before = descriptors()
    for _ in range(3):
        latch.latch(who="ann", reason="smoke", audit=audit)
        latch.reset(who="bea", role="admin", audit=audit)
    assert descriptors() == before
    latch.reserve()
    assert descriptors() == before + 1
    assert latch.release()
    assert not latch.release()
    assert descriptors() == before


def test_reserving_a_descriptor_where_there_is_none_is_no_failure(latch) -> None:
    next_one = os.dup(0)
    os.close(next_one)
    with no_more(resource.RLIMIT_NOFILE, next_one):
        latch.reserve()
    assert not latch.release()


# Notifications


def test_all_robots_are_stopped_before_a_file_is_written_and_all_files_before_anybody_is_told(
    tmp_path: Path,
) -> None:
    left, nowhere, right = a_latch(tmp_path / "left"), a_latch(NOWHERE), a_latch(tmp_path / "right")
    seen: list[tuple[str, str, list[str]]] = []
    for name, latch in (("left", left), ("nowhere", nowhere), ("right", right)):
        latch.on_press.append(
            lambda name=name: seen.append(("press", name, sorted(os.listdir(tmp_path))))
        )
        latch.on_pressed.append(
            lambda name=name: seen.append(("pressed", name, sorted(os.listdir(tmp_path))))
        )
    failures = EmergencyStopLatch.press_together([left, nowhere, right], who="ann", reason="smoke")
    names, both = ("left", "nowhere", "right"), ["left", "right"]
    assert seen == [("press", name, []) for name in names] + [
        ("pressed", name, both) for name in names
    ]
    assert [str(NOWHERE) in failure.message for failure in failures] == [True]
    assert all(latch.is_latched() for latch in (left, nowhere, right))


def test_a_second_press_tells_nobody_and_the_first_cause_stays(latch) -> None:
    told: list[str] = []
    latch.on_press.append(lambda: told.append("press"))
    latch.on_pressed.append(lambda: told.append("pressed"))
    latch.press(who="ann", reason="smoke")
    assert latch.press(who="bob", reason="fire").cause == 'ann: "smoke"'
    assert told == ["press", "pressed"]
