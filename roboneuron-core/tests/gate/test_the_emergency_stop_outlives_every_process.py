"""The latch: across processes and restarts, closed if in doubt, reset by an admin only and always
with a record.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from roboneuron.errors import RefusedError, StateError, UnsafeError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.gate import AuditLog

PRESS = """
import os, signal, sys, time
from pathlib import Path
from roboneuron.estop import EmergencyStopLatch
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
    with pytest.raises(RefusedError, match='latched by other process: "test"'):
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


def test_a_process_without_file_handles_stops_the_others_by_the_one_it_keeps(latch) -> None:
    latch.reserve()
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    next_one = os.dup(0)
    os.close(next_one)
    resource.setrlimit(resource.RLIMIT_NOFILE, (next_one, before[1]))
    try:
        with pytest.raises(OSError, match="Too many open files"):
            os.dup(0)
        latch.press(who="a", reason="b")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert latch.path.exists()
    assert latch.read_state().who == "a"
    assert latch.release()  # it keeps one again
    assert not latch.release()


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
        latch.reset(
            who="c", role="admin", audit=AuditLog(tmp_path / "file" / "audit", clock.wall_ns)
        )
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
    threads = [
        threading.Thread(target=latch.latch, kwargs={"who": f"t{i}", "reason": "x" * 100})
        for i in range(16)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert latch.read_state().who.startswith("t")
    assert os.listdir(latch.path.parent) == [latch.path.name]


def test_who_listens_is_told_before_anything_is_written(latch) -> None:
    seen = []
    latch.on_press.append(
        lambda: seen.append((latch.is_latched(), latch.path.exists(), latch.read_state().who))
    )
    latch.latch(who="a", reason="b")
    latch.latch(who="c", reason="d")
    assert seen == [(True, False, "a")]


def test_pressing_waits_for_no_disk(latch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: pytest.fail("the disk was waited for"))
    latch.press(who="a", reason="b")
    assert json.loads(latch.path.read_text())["who"] == "a"


def other(latch, clock, **more) -> EmergencyStopLatch:
    """The latch as in another process, which has seen that it is set."""
    found = EmergencyStopLatch(latch.path, clock.wall_ns, **more)
    assert found.is_latched()
    return found


def remove_file(path: Path) -> None:
    path.unlink()


def remove_directory(path: Path) -> None:
    shutil.rmtree(path.parent)


def move_directory_away(path: Path) -> None:
    path.parent.rename(path.parent.with_suffix(".old"))


def rename_file(path: Path) -> None:
    path.rename(path.with_suffix(".bak"))


def put_a_copy_of_the_directory(path: Path) -> None:
    """As when a backup is restored: its record of an earlier reset is not a reset."""
    copy = path.parent.with_suffix(".copy")
    shutil.copytree(path.parent, copy)
    shutil.rmtree(path.parent)
    (copy / path.name).rename(copy / f"{path.name}.reset")
    copy.rename(path.parent)


@pytest.mark.parametrize(
    "remove",
    [remove_file, remove_directory, move_directory_away, rename_file, put_a_copy_of_the_directory],
)
@pytest.mark.parametrize("had_a_reset", [False, True])
def test_a_file_that_vanishes_without_a_reset_is_written_again(
    latch,
    clock,
    audit,
    remove: Callable[[Path], None],
    had_a_reset: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if had_a_reset:
        latch.latch(who="earlier", reason="")
        latch.reset(who="c", role="admin", audit=audit)
    latch.latch(who="a", reason="b")
    watching = other(latch, clock)
    for times in (1, 2):
        remove(latch.path)
        assert latch.is_latched()
        assert watching.is_latched()
        assert latch.path.exists()
        assert (watching.read_state().who, watching.read_state().restored) == ("a", times)
        assert "vanished without a reset" in caplog.text
        assert other(latch, clock).read_state().restored == times, (
            "a new process learns it from the file"
        )
        shutil.rmtree(latch.path.parent.with_suffix(".old"), ignore_errors=True)
    latch.reset(who="c", role="admin", audit=audit)
    assert not latch.is_latched()
    assert not watching.is_latched()
    assert not latch.path.exists()


@pytest.mark.parametrize(
    "make", [Path.touch, lambda path: path.symlink_to("nowhere")], ids=["touch", "dangling-link"]
)
def test_a_file_made_by_hand_holds_and_is_reset_like_any_other(latch, clock, audit, make) -> None:
    latch.path.parent.mkdir()
    make(latch.path)
    watching = other(latch, clock)
    latch.path.unlink()
    assert watching.is_latched()
    make(latch.path) if not os.path.lexists(latch.path) else None
    EmergencyStopLatch(latch.path, clock.wall_ns).reset(who="c", role="admin", audit=audit)
    assert not watching.is_latched()
    assert not os.path.lexists(latch.path)


def test_a_reset_reaches_who_holds_it_however_often_it_is_pressed_again(
    latch, clock, audit
) -> None:
    for _ in range(5):
        latch.latch(who="a", reason="b")
        watching = other(latch, clock)
        EmergencyStopLatch(latch.path, clock.wall_ns).reset(who="c", role="admin", audit=audit)
        assert not watching.is_latched()
        assert not latch.is_latched()


def test_what_cannot_be_written_again_stays_latched_and_is_tried_again(
    latch, clock, tmp_path, caplog
) -> None:
    now_s = [100.0]
    latch.latch(who="a", reason="b")
    watching = other(latch, clock, clock_s=lambda: now_s[0])
    shutil.rmtree(latch.path.parent)
    latch.path.parent.write_text("in the way")
    latch.path.parent.unlink()
    latch.path.parent.symlink_to("/proc/nowhere/at/all")
    for _ in range(3):
        assert watching.is_latched()
    assert caplog.text.count("cannot be written") == 1
    with pytest.raises(StateError, match="stays latched"):
        watching.reset(who="c", role="admin", audit=AuditLog(tmp_path / "audit", clock.wall_ns))
    assert watching.is_latched()
    latch.path.parent.unlink()
    now_s[0] += 2.0
    assert watching.is_latched()
    assert json.loads(latch.path.read_text())["who"] == "a"


def test_a_reset_by_another_process_races_with_nobody_who_looks(latch, clock, audit) -> None:
    """Polling during another process's reset never writes the file again."""
    end = threading.Event()
    watching = EmergencyStopLatch(latch.path, clock.wall_ns)

    def look() -> None:
        while not end.is_set():
            watching.is_latched()

    threads = [threading.Thread(target=look) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(100):
            latch.press(who="a", reason="b")
            while not watching.is_latched():
                pass
            latch.reset(who="c", role="admin", audit=audit)
            deadline_s = time.monotonic() + 5
            while watching.is_latched() and time.monotonic() < deadline_s:
                pass
            assert not watching.is_latched()
            assert not latch.is_latched()
    finally:
        end.set()
        for thread in threads:
            thread.join()
