"""One child process: how it is ended, without any remains.

The children are shells; no module and no ROS node is started.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from shells import ENVIRONMENT, SOON_S, Spawn, await_line, child_of, end_now, state_of

from rn_testing.waiting import wait_until
from roboneuron.hang_watch import END_SIGNAL
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents, spawn

pytestmark = pytest.mark.timeout(60)


def test_it_has_no_exit_code_before_all_is_cleaned_up(start: Spawn) -> None:
    events, facts = ProcessEvents(), list[Any]()
    events.ended.listen(lambda pid, name: facts.append((pid, name, process.exit_code)))
    ended = threading.Event()

    def on_exit(gone: ModuleProcess) -> None:
        facts.append((gone, gone.exit_code))
        ended.set()

    process = start("read line; read line; read line; exit 7", events=events, on_exit=on_exit)
    assert process.exit_code is None
    assert not process.wait(0.0)
    process.beat()
    assert process.wait(SOON_S)
    assert process.exit_code == 7
    assert ended.wait(SOON_S)
    assert facts == [(process.pid, "arm", None), (process, 7)]


def test_a_reaper_is_named_and_holds_nobody_up(start: Spawn) -> None:
    before = set(threading.enumerate())
    start("cat")
    reapers = set(threading.enumerate()) - before
    assert [(thread.name, thread.daemon) for thread in reapers] == [("reaper-arm", True)]


def test_the_input_of_a_process_that_has_ended_is_closed(start: Spawn) -> None:
    process = start("true")
    assert process.wait(SOON_S)
    assert process._child.stdin is not None
    assert process._child.stdin.closed


def test_what_a_process_leaves_behind_is_killed_at_its_end(start: Spawn, log_path: Path) -> None:
    process = start("sleep 60 & echo child $!")
    assert process.wait(SOON_S)
    assert process.exit_code == 0
    pid = child_of(log_path)
    wait_until(lambda: state_of(pid) == "Z", SOON_S, "its child is alive")


def test_sigterm_lets_a_process_leave_by_itself(start: Spawn, log_path: Path) -> None:
    process = start("trap 'echo bye; exit 4' TERM; echo up; while :; do read line; done")
    await_line(log_path, "up")
    process.terminate()
    assert process.wait(SOON_S)
    assert process.exit_code == 4
    assert process.last_lines()[-1] == "bye"


def test_sigterm_reaches_the_process_and_not_what_it_has_started(
    start: Spawn, log_path: Path
) -> None:
    """A module first releases its device; its children are killed at its end."""
    process = start(
        "trap 'echo asked' TERM; sleep 60 & echo child $!; echo up; while :; do wait; done"
    )
    await_line(log_path, "up")
    process.terminate()
    await_line(log_path, "asked")
    assert state_of(child_of(log_path)) != "Z"


def test_sigkill_ends_a_process_that_does_not_listen_and_its_children(
    start: Spawn, log_path: Path
) -> None:
    events, seen = ProcessEvents(), list[str]()
    process = start(
        "trap '' TERM; sleep 60 & echo child $!; echo up; while :; do sleep 60; done",
        events=events,
    )
    events.seen.listen(lambda pid: seen.append(state_of(pid)))
    await_line(log_path, "up")
    process.terminate()
    assert not process.wait(0.05)
    process.kill()
    assert process.wait(SOON_S)
    assert process.exit_code == -signal.SIGKILL
    pid = child_of(log_path)
    wait_until(lambda: state_of(pid) == "Z", SOON_S, "its child is alive")
    assert len(seen) == 1
    assert seen[0] != "Z", "it is looked at while it lives"


LEAVER = "import os, time; os.setpgid(0, os.getppid()); print('up', flush=True); time.sleep(60)"


def test_sigkill_reaches_a_process_that_has_left_its_group(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, "-I", "-S", "-c", LEAVER.replace("os.getppid()", str(os.getpgid(0)))]
    process = spawn("arm", command, ENVIRONMENT, "go", log_path, ProcessEvents())
    process.reap(lambda process: None)
    try:
        await_line(log_path, "up")
        assert os.getpgid(process.pid) == os.getpgid(0)
        process.kill()
        assert process.wait(SOON_S)
        assert process.exit_code == -signal.SIGKILL
    finally:
        end_now(process)


def test_sigkill_is_for_the_children_first_then_for_a_process_that_has_left_its_group(
    start: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its children end even if it hangs in a driver."""
    process = start("cat")
    sent: list[tuple[str, int, int]] = []
    with monkeypatch.context() as patch:
        for name in ("killpg", "kill"):
            patch.setattr(os, name, lambda pid, number, name=name: sent.append((name, pid, number)))
        process.kill()
    assert sent == [
        ("killpg", process.pid, signal.SIGKILL),
        ("kill", process.pid, signal.SIGKILL),
    ]


HANGS = """
import ctypes, os, subprocess, threading, time
from roboneuron.hang_watch import HangWatch
HangWatch(1.0).start()
print("child", subprocess.Popen(["sleep", "60"]).pid, flush=True)
threading.Thread(target=ctypes.PyDLL(None).sleep, args=(60,), daemon=True).start()
time.sleep(60)
"""


def test_a_process_whose_interpreter_hangs_is_noted_and_leaves_no_children(log_path: Path) -> None:
    process = spawn("arm", [sys.executable, "-c", HANGS], os.environ, "", log_path, ProcessEvents())
    process.reap(lambda process: None)
    try:
        assert process.wait(SOON_S)
        assert process.exit_code == -END_SIGNAL
        assert process.last_lines()[-1].endswith("its interpreter hung, with threads as above.")
        assert any("most recent call first" in line for line in process.last_lines())
        pid = child_of(log_path)
        wait_until(lambda: state_of(pid) == "Z", SOON_S, "its child is alive")
    finally:
        end_now(process)


def test_no_signal_is_sent_to_a_process_that_was_reaped(
    start: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pid may already belong to another process."""
    process = start("true")
    assert process.wait(SOON_S)
    sent: list[int] = []
    monkeypatch.setattr(os, "kill", lambda pid, number: sent.append(pid))
    monkeypatch.setattr(os, "killpg", lambda group, number: sent.append(group))
    process.terminate()
    process.kill()
    assert sent == []


def test_a_process_that_vanishes_meanwhile_is_no_error(
    start: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = start("cat")

    def fail(pid: int, number: int) -> None:
        raise ProcessLookupError

    def forbid(group: int, number: int) -> None:
        raise PermissionError

    with monkeypatch.context() as patch:
        patch.setattr(os, "kill", fail)
        patch.setattr(os, "killpg", forbid)
        process.terminate()
        process.kill()
        patch.setattr(os, "killpg", fail)
        process.kill()


@pytest.mark.parametrize("act", ["terminate", "kill", "beat"])
def test_a_process_is_not_reaped_while_it_is_acted_upon(start: Spawn, act: str) -> None:
    process = start("cat")
    done = threading.Event()
    with process._reaping:
        thread = threading.Thread(target=lambda: (getattr(process, act)(), done.set()))
        thread.start()
        assert not done.wait(0.05)
    thread.join(SOON_S)
    assert done.is_set()


def test_a_process_is_not_collected_while_a_signal_is_on_its_way(start: Spawn) -> None:
    process = start("read line; read line; read line")
    with process._reaping:
        assert process._child.stdin is not None
        os.write(process._child.stdin.fileno(), b"\n")
        wait_until(lambda: state_of(process.pid) == "Z", SOON_S, "it has not ended")
        assert not process.wait(0.05)
        assert Path(f"/proc/{process.pid}").exists(), "its number was given back"
    assert process.wait(SOON_S)
