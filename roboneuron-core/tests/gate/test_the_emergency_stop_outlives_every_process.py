"""The latch: across processes and restarts, closed when in doubt, reset by an admin only and never without a record."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from roboneuron.errors import RefusedError, StateError, UnsafeError
from roboneuron.gate import AuditLog, EmergencyStopLatch

PRESS = """
import os, signal, sys, time
from pathlib import Path
from roboneuron.gate import EmergencyStopLatch
EmergencyStopLatch(Path(sys.argv[1]), time.time_ns).latch(who="other process", reason="test")
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_fresh_latch_is_open_and_touches_nothing(latch) -> None:
    assert not latch.is_latched()
    assert not latch.read_state().latched
    latch.check()
    assert not latch.path.parent.exists()


def test_it_is_seen_by_another_object_and_keeps_the_first_cause(latch, clock) -> None:
    latch.latch(who="a", reason="first")
    latch.latch(who="b", reason="second")
    other = EmergencyStopLatch(latch.path, clock.wall_ns)
    assert other.is_latched()
    state = other.read_state()
    assert (state.who, state.reason, state.time_ns) == ("a", "first", clock.start_ns + 1)
    assert [p.name for p in latch.path.parent.iterdir()] == [latch.path.name]


def test_it_survives_the_kill_of_the_process_that_pressed_it(latch) -> None:
    done = subprocess.run([sys.executable, "-c", PRESS, str(latch.path)], timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    assert latch.is_latched()
    with pytest.raises(RefusedError, match="latched by other process: test"):
        latch.check()


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b'{"who": 1}', b"[" * 100_000])
def test_whatever_the_file_holds_it_is_latched(latch, content: bytes) -> None:
    latch.path.parent.mkdir()
    latch.path.write_bytes(content)
    assert latch.is_latched()
    assert latch.read_state().who == ""
    with pytest.raises(RefusedError):
        latch.check()


def test_what_cannot_be_read_counts_as_latched(tmp_path: Path, clock) -> None:
    (tmp_path / "file").touch()
    assert EmergencyStopLatch(tmp_path / "file" / "stop", clock.wall_ns).is_latched()


def test_if_it_cannot_be_written_this_process_stops_and_says_so(clock) -> None:
    latch = EmergencyStopLatch(Path("/proc/nothing/stop"), clock.wall_ns)
    with pytest.raises(UnsafeError, match="only this process is stopped"):
        latch.latch(who="a", reason="b")
    assert latch.is_latched()


def test_a_reset_needs_an_admin_and_is_written_down_first(latch, audit) -> None:
    latch.latch(who="a", reason="b")
    for role in ("viewer", "operator", "", "Admin"):
        with pytest.raises(RefusedError, match="needs the role 'admin'"):
            latch.reset(who="c", role=role, audit=audit)
    assert latch.is_latched()
    latch.reset(who="c", role="admin", audit=audit)
    assert not latch.is_latched()
    records = [json.loads(line) for line in audit.path.read_text().splitlines()]
    assert [r["verdict"] for r in records] == ["refused"] * 4 + ["allowed"]
    assert {r["tool"] for r in records} == {"reset_emergency_stop"}


def test_there_is_no_reset_without_an_audit(latch, tmp_path: Path, clock) -> None:
    latch.latch(who="a", reason="b")
    (tmp_path / "file").touch()
    with pytest.raises(RefusedError, match="audit"):
        latch.reset(who="c", role="admin", audit=AuditLog(tmp_path / "file" / "audit", clock.wall_ns))
    assert latch.is_latched()


def test_a_latch_that_cannot_be_removed_stays(latch, audit) -> None:
    latch.path.mkdir(parents=True)
    with pytest.raises(StateError, match="stays latched"):
        latch.reset(who="c", role="admin", audit=audit)
    assert latch.is_latched()


def test_a_reset_of_an_open_latch_is_harmless(latch, audit) -> None:
    latch.reset(who="c", role="admin", audit=audit)
    assert not latch.is_latched()


def test_pressing_from_many_threads_leaves_one_whole_file(latch) -> None:
    threads = [threading.Thread(target=latch.latch, kwargs={"who": f"t{i}", "reason": "x" * 100}) for i in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert latch.read_state().who.startswith("t")
    assert os.listdir(latch.path.parent) == [latch.path.name]


def test_who_listens_is_told_before_anything_is_written(latch) -> None:
    seen = []
    latch.on_press(lambda: seen.append((latch.is_latched(), latch.path.exists(), latch.read_state().who)))
    latch.latch(who="a", reason="b")
    latch.latch(who="c", reason="d")
    assert seen == [(True, False, "a")]


def test_pressing_waits_for_no_disk(latch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: pytest.fail("the disk was waited for"))
    latch.press(who="a", reason="b")
    assert json.loads(latch.path.read_text())["who"] == "a"
