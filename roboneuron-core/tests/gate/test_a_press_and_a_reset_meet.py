"""Stops and resets by several processes, and what a reset records and keeps."""

from __future__ import annotations

import errno
import itertools
import json
import os
from pathlib import Path

import pytest
from standing_latch import TIME_NS, a_latch

from roboneuron.errors import RefusedError, StateError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog, AuditRecord


@pytest.fixture
def latch(tmp_path: Path) -> EmergencyStopLatch:
    return a_latch(tmp_path / "state" / "stop")


@pytest.fixture
def audit(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit", lambda: TIME_NS)


# Stops and resets by several processes


def test_a_press_right_after_a_reset_by_another_process_stops_again(latch, audit) -> None:
    latch.press(who="ann", reason="smoke")
    a_latch(latch.path).reset(who="bea", role="admin", audit=audit)
    assert (
        EmergencyStopLatch.press_together([latch], who="ann", reason="fire") == []
    )  # it has not checked the file since
    assert a_latch(latch.path).read_state().cause == 'ann: "fire"'


def test_only_the_stop_that_was_seen_is_released(latch, audit) -> None:
    ticking = itertools.count(TIME_NS)
    guard = EmergencyStopLatch(latch.path, lambda: next(ticking))
    none_ns = latch.read_state().time_ns
    first_ns = guard.press(who="ann", reason="smoke").time_ns
    with pytest.raises(RefusedError, match="pressed again"):
        latch.reset(who="bea", role="admin", audit=audit, agreed_ns=none_ns)
    assert guard.is_latched()
    latch.reset(who="bea", role="admin", audit=audit, agreed_ns=first_ns)
    assert not guard.is_latched()
    guard.press(who="ann", reason="fire")
    with pytest.raises(RefusedError, match="pressed again"):
        latch.reset(who="bea", role="admin", audit=audit, agreed_ns=first_ns)
    assert guard.read_state().cause == 'ann: "fire"'
    told = [json.loads(line) for line in audit.path.read_text().splitlines()]
    assert [(one["verdict"], one.get("rule", "")) for one in told[-2:]] == [
        ("allowed", ""),
        ("refused", "person"),
    ]


def test_a_press_that_could_not_be_written_is_written_by_the_next(tmp_path: Path) -> None:
    (tmp_path / "state").touch()  # blocks the directory
    latch = a_latch(tmp_path / "state" / "stop")
    for _ in range(2):
        assert len(EmergencyStopLatch.press_together([latch], who="ann", reason="smoke")) == 1
    (tmp_path / "state").unlink()
    assert EmergencyStopLatch.press_together([latch], who="ann", reason="smoke") == []
    assert a_latch(latch.path).read_state().cause == 'ann: "smoke"'


def test_who_presses_what_another_has_latched_is_released_with_it(latch, audit) -> None:
    other = a_latch(latch.path)
    other.press(who="bob", reason="fire")
    assert EmergencyStopLatch.press_together([latch], who="ann", reason="smoke") == []
    assert json.loads(latch.path.read_text())["who"] == "bob"
    other.reset(who="bea", role="admin", audit=audit)
    assert not latch.is_latched()
    assert not latch.path.exists()


def test_a_file_that_vanishes_while_it_is_pressed_fails_no_press(
    latch, monkeypatch: pytest.MonkeyPatch
) -> None:
    a_latch(latch.path).press(who="bob", reason="fire")

    def vanish(path: Path) -> os.stat_result:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(os, "lstat", vanish)
        assert EmergencyStopLatch.press_together([latch], who="ann", reason="smoke") == []
        assert latch.is_latched()
    assert latch.is_latched()


@pytest.mark.parametrize(("elapsed_s", "attempts"), [(0.0, 1), (0.75, 1), (1.0, 2), (60.0, 2)])
def test_a_latch_that_cannot_be_written_is_tried_once_a_second(
    tmp_path: Path, elapsed_s: float, attempts: int, caplog: pytest.LogCaptureFixture
) -> None:
    now_s = [100.0]
    latch = EmergencyStopLatch(tmp_path / "state" / "stop", lambda: TIME_NS, lambda: now_s[0])
    latch.press(who="ann", reason="smoke")
    latch.path.unlink()
    latch.path.parent.rmdir()
    latch.path.parent.symlink_to("/proc/nowhere/at/all")
    assert latch.is_latched()
    now_s[0] += elapsed_s
    for _ in range(3):
        assert latch.is_latched()
    assert caplog.text.count("cannot be written") == attempts
    assert caplog.text.count("vanished without a reset") == 1
    assert latch.read_state().restored == 1


# The reset


def test_a_reset_is_recorded_with_who_asked_and_what_refused_it(
    latch, audit, records, synced
) -> None:
    latch.press(who="ann", reason="smoke")
    with pytest.raises(RefusedError):
        latch.reset(who="bob", role="operator", audit=audit)
    latch.reset(who="bea", role="admin", audit=audit)
    tool = "reset_emergency_stop"
    assert records == [
        AuditRecord(who="bob", role="operator", tool=tool, verdict="refused", rule="role"),
        AuditRecord(who="bea", role="admin", tool=tool, verdict="allowed"),
    ]
    assert synced == [str(latch.path.parent)], "the reset is on the disk, too"


def test_a_reset_that_gives_no_pin_is_refused_where_one_is_set(latch, audit, records) -> None:
    ReleasePin(latch.path.parent).set("4711")
    latch.press(who="ann", reason="smoke")
    with pytest.raises(RefusedError, match="missing"):
        latch.reset(who="bea", role="admin", audit=audit)
    assert latch.is_latched()
    assert [record.verdict for record in records] == ["refused"]


def test_a_reset_of_an_open_latch_makes_no_file(latch, audit) -> None:
    latch.path.parent.mkdir()
    latch.reset(who="bea", role="admin", audit=audit)
    assert os.listdir(latch.path.parent) == []


def test_a_reset_keeps_the_file_with_its_cause_under_another_name(latch, audit) -> None:
    latch.press(who="ann", reason="smoke")
    latch.reset(who="bea", role="admin", audit=audit)
    assert os.listdir(latch.path.parent) == ["stop.reset"]
    assert json.loads((latch.path.parent / "stop.reset").read_text())["who"] == "ann"


def test_a_latch_that_was_never_written_is_written_before_it_is_reset(
    tmp_path: Path, audit
) -> None:
    """Without a writable file there is no reset."""
    (tmp_path / "state").touch()  # blocks the directory
    latch = a_latch(tmp_path / "state" / "stop")
    EmergencyStopLatch.press_together([latch], who="ann", reason="smoke")
    with pytest.raises(StateError, match="stays latched"):
        latch.reset(who="bea", role="admin", audit=audit)
    (tmp_path / "state").unlink()
    latch.reset(who="bea", role="admin", audit=audit)
    assert not latch.is_latched()
    assert json.loads((tmp_path / "state" / "stop.reset").read_text())["who"] == "ann"


def test_a_directory_in_place_of_the_file_is_not_reset(latch, audit) -> None:
    latch.path.mkdir(parents=True)
    with pytest.raises(StateError, match="it is a directory; it stays latched") as failed:
        latch.reset(who="bea", role="admin", audit=audit)
    assert isinstance(failed.value.__cause__, OSError)
    assert failed.value.__cause__.errno == errno.EISDIR
    assert latch.is_latched()


def test_a_press_after_a_reset_that_the_disk_refused_stops_the_robot(
    latch, audit, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    latch.on_press.append(lambda: told.append("press"))

    def fail(path: Path) -> os.stat_result:
        raise OSError(errno.EIO, "Input/output error", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(os, "lstat", fail)
        with pytest.raises(StateError, match="stays latched"):
            latch.reset(who="bea", role="admin", audit=audit)
    EmergencyStopLatch.press_together([latch], who="ann", reason="smoke")
    assert told == ["press"]
