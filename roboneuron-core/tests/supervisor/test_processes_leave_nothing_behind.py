"""One child process: what it is given, how it is told to leave, and what may remain of it: nothing.

The children are shells; no module and no ROS node is started.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from rn_testing.waiting import wait_until
from roboneuron.errors import NotReadyError
from roboneuron.supervisor import changes as changes_module
from roboneuron.supervisor import process as process_module
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents, spawn

pytestmark = pytest.mark.timeout(60)
SOON_S = 10.0
"""Milliseconds on an idle machine."""
ENVIRONMENT = {"PATH": os.environ["PATH"], "ROBOT": "pair"}
START = "read line; echo up; "
"""Once this shell has written `up`, its traps are set."""
Spawn = Callable[..., ModuleProcess]


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    return tmp_path / "log" / "arm.log"


@pytest.fixture
def start(log_path: Path) -> Iterator[Spawn]:
    """Return a function that starts a shell with a script and reaps it; all are dead in the end."""
    started: list[ModuleProcess] = []

    def run(
        script: str,
        *,
        first_line: str = "go",
        events: ProcessEvents | None = None,
        environment: Mapping[str, str] = ENVIRONMENT,
        on_exit: Callable[[ModuleProcess], None] | None = None,
    ) -> ModuleProcess:
        process = spawn(
            "arm",
            ("/bin/sh", "-c", script),
            environment,
            first_line,
            log_path,
            events or ProcessEvents(),
        )
        started.append(process)
        process.reap(on_exit or (lambda process: None))
        return process

    yield run
    for process in started:
        end_now(process)


def end_now(process: ModuleProcess) -> None:
    """Not by Popen, which would reap it under its reaper's hands."""
    if process.exit_code is None:
        for end in (os.killpg, os.kill):
            with suppress(OSError):
                end(process.pid, signal.SIGKILL)
    process.wait(1.0)


def await_line(path: Path, line: str) -> None:
    wait_until(
        lambda: path.exists() and line in path.read_text().splitlines(), SOON_S, f"no line {line}"
    )


def state_of(pid: int) -> str:
    """The letter of proc(5); Z too when nobody is left who knows the process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def child_of(path: Path) -> int:
    """The pid that a script has written after `child `."""
    wait_until(lambda: path.exists() and "child " in path.read_text(), SOON_S, "no child")
    return int(path.read_text().partition("child ")[2].split()[0])


# What a process is given


def test_a_process_reads_its_first_line_and_a_first_sign_of_life(
    start: Spawn, log_path: Path
) -> None:
    process = start("cat", first_line="settings é")
    wait_until(lambda: log_path.read_bytes() == "settings é\n\n".encode(), SOON_S, "no first line")
    assert process.exit_code is None, "its input stays open"


def test_a_process_has_the_given_environment_and_no_other(start: Spawn, log_path: Path) -> None:
    assert start('echo "$ROBOT ${HOME:-none}"').wait(SOON_S)
    assert log_path.read_text() == "pair none\n"


def test_all_output_goes_to_the_log_after_what_is_there(start: Spawn, log_path: Path) -> None:
    log_path.parent.mkdir()
    log_path.write_text("of the one before\n")
    process = start("echo out; echo err >&2")
    assert process.wait(SOON_S)
    assert log_path.read_text() == "of the one before\nout\nerr\n"
    assert process.last_lines() == ("out", "err"), "its own lines only"


def test_a_log_that_is_made_is_closed_to_others(start: Spawn, log_path: Path) -> None:
    assert start("true").wait(SOON_S)
    assert log_path.stat().st_mode & 0o007 == 0
    assert log_path.parent.stat().st_mode & 0o007 == 0


def test_a_process_leads_a_group_in_the_session_of_the_server(start: Spawn) -> None:
    process = start("cat")
    assert os.getpgid(process.pid) == process.pid
    assert os.getsid(process.pid) == os.getsid(0), "else it stays frozen when the server dies"


def test_a_process_knows_its_name_its_log_and_when_it_began(start: Spawn, log_path: Path) -> None:
    process = start("cat")
    assert (process.name, process.log_path) == ("arm", log_path)
    assert timedelta(0) <= datetime.now(UTC) - process.started_at < timedelta(seconds=SOON_S)


def test_listeners_hear_of_a_process_before_it_is_started(start: Spawn, log_path: Path) -> None:
    events, logs = ProcessEvents(), []
    events.spawning.listen(lambda: logs.append(log_path.exists()))
    start("true", events=events)
    assert logs == [False]


def test_a_process_that_dies_before_it_reads_is_left_to_its_reaper(start: Spawn) -> None:
    process = start("exit 3", first_line="x" * 300_000)
    assert process.wait(SOON_S)
    assert process.exit_code == 3


def test_a_command_that_does_not_exist_is_an_error(log_path: Path) -> None:
    with pytest.raises(OSError, match="no-such-command"):
        spawn("arm", ["/no-such-command"], {}, "go", log_path, ProcessEvents())


# What it is told while it lives


def test_a_beat_is_one_empty_line_and_an_announcement_a_line(start: Spawn, log_path: Path) -> None:
    process = start("cat")
    process.beat()
    process.announce(b"digest")
    process.beat()
    wait_until(
        lambda: log_path.read_bytes() == b"go\n\n\ndigest\n\n", SOON_S, "not what it was told"
    )


def test_a_process_that_does_not_read_is_announced_nothing(start: Spawn, log_path: Path) -> None:
    process = start("echo up; exec sleep 60")
    await_line(log_path, "up")

    def fill() -> None:
        for _ in range(2000):
            process.announce(b"x" * 999)

    with pytest.raises(NotReadyError, match=rf"arm \(pid {process.pid}\) does not read"):
        fill()
    beat = threading.Thread(target=process.beat, daemon=True)
    beat.start()
    beat.join(SOON_S)
    assert not beat.is_alive(), "the heartbeat of all modules waits for it"


def test_nothing_is_written_to_a_process_that_has_ended(
    start: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = start("true")
    assert process.wait(SOON_S)
    written: list[bytes] = []
    monkeypatch.setattr(os, "write", lambda descriptor, data: written.append(data))
    process.beat()
    process.announce(b"digest")
    assert written == [], "the descriptor may be another file's by now"


def test_a_pipe_that_breaks_while_it_is_written_to_is_no_error(
    start: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = start("cat")

    def write(descriptor: int, data: bytes) -> int:
        raise BrokenPipeError

    monkeypatch.setattr(os, "write", write)
    process.announce(b"digest")


def test_listeners_are_shown_the_living_process(start: Spawn) -> None:
    events, seen = ProcessEvents(), list[int]()
    events.seen.listen(seen.append)
    process = start("cat", events=events)
    assert seen == []
    process.show()
    assert seen == [process.pid]


def test_a_note_stands_among_the_last_lines_and_passes_for_one_entry(
    start: Spawn, log_path: Path
) -> None:
    process = start("echo up; cat >/dev/null")
    await_line(log_path, "up")
    process.note("killed\nERROR \x1b[2Jé")
    assert process.last_lines() == ("up", "killed", "    ERROR \\x1b[2Jé")
    log_path.unlink()
    process.note("again")
    assert log_path.stat().st_mode & 0o007 == 0
    log_path.unlink()
    log_path.parent.rmdir()
    process.note("nowhere to write it")


# How it ends


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
    """A module releases its device first; its children are killed at its end."""
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
    """Its children end though it hangs in a driver itself."""
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


def test_no_signal_is_sent_to_a_process_that_was_reaped(
    start: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its number may be another process's by now."""
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


# Whether it is frozen


class Clock:
    """A clock that stands where a test sets it."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(changes_module, "time", clock)
    monkeypatch.setattr(process_module, "time", clock)
    return clock


@pytest.mark.parametrize(
    ("stat", "is_stopped"),
    [
        (b"7 (arm) T 1 7 7", True),
        (b"7 (arm) t 1 7 7", True),
        (b"7 (arm) S 1 7 7", False),
        (b"7 (arm) Z 1 7 7", False),
        (b"7 (arm) T 1) S 1 7 7", False),
        (b"7 (arm) S 1) T 1 7 7", True),
        (b"7 (\xffrm) T 1 7 7", True),
        (b"", False),
        (None, False),
    ],
)
def test_a_process_is_frozen_when_the_kernel_has_stopped_it_for_a_while(
    start: Spawn,
    clock: Clock,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stat: bytes | None,
    is_stopped: bool,
) -> None:
    process = start("cat")
    file = tmp_path / "stat"
    if stat is not None:
        file.write_bytes(stat)

    def find(path: str) -> Path:
        assert path == f"/proc/{process.pid}/stat"
        return file

    monkeypatch.setattr(process_module, "Path", find)
    assert not process.is_frozen(), "it may have been stopped a moment ago"
    clock.now_s += 0.3
    assert not process.is_frozen()
    clock.now_s += 0.001
    assert process.is_frozen() == is_stopped


def test_a_process_is_frozen_after_that_time_and_not_at_its_end(
    start: Spawn, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_module, "_FROZEN_S", 0.25)
    process = start("cat")
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(process.pid) == "T", SOON_S, "it runs")
    assert not process.is_frozen()
    clock.now_s += 0.25
    assert not process.is_frozen()


def test_a_process_that_goes_on_in_between_is_not_frozen(start: Spawn, clock: Clock) -> None:
    process = start("cat")
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(process.pid) == "T", SOON_S, "it runs")
    assert not process.is_frozen()
    clock.now_s += 1.0
    assert process.is_frozen()
    os.kill(process.pid, signal.SIGCONT)
    wait_until(lambda: state_of(process.pid) != "T", SOON_S, "it is stopped")
    assert not process.is_frozen()
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(process.pid) == "T", SOON_S, "it runs")
    assert not process.is_frozen(), "it counts from now on"


# Several that are ended together


class Fake:
    """A process that leaves so long after SIGTERM or SIGKILL, on a clock of the test."""

    def __init__(
        self,
        pid: int,
        clock: Clock,
        calls: list[tuple[Any, ...]],
        *,
        leaves_after_s: float = 0.0,
        dies_after_s: float = 0.0,
    ) -> None:
        self.pid, self.name = pid, f"module-{pid}"
        self._clock, self._calls = clock, calls
        self._leaves_after_s, self._dies_after_s = leaves_after_s, dies_after_s
        self._end_s = float("inf")

    def show(self) -> None:
        self._calls.append(("show", self.pid))

    def terminate(self) -> None:
        self._calls.append(("terminate", self.pid))
        self._end_s = self._clock.now_s + self._leaves_after_s

    def kill(self) -> None:
        self._calls.append(("kill", self.pid))
        self._end_s = self._clock.now_s + self._dies_after_s

    def wait(self, timeout_s: float) -> bool:
        self._calls.append(("wait", self.pid, round(timeout_s, 6)))
        until_s = min(self._end_s, self._clock.now_s + timeout_s)
        self._clock.now_s = max(self._clock.now_s, until_s)
        return self._end_s <= self._clock.now_s


def end(processes: Sequence[Fake], timeout_s: float) -> set[int]:
    return process_module.end_processes(processes, timeout_s)  # type: ignore[arg-type]


def test_all_are_told_to_leave_before_any_is_waited_for(clock: Clock) -> None:
    calls: list[tuple[Any, ...]] = []
    assert end([Fake(pid, clock, calls, leaves_after_s=0.5) for pid in (1, 2)], 3.0) == set()
    assert calls == [
        ("show", 1),
        ("terminate", 1),
        ("show", 2),
        ("terminate", 2),
        ("wait", 1, 3.0),
        ("wait", 2, 2.5),
        ("wait", 1, 5.0),
        ("wait", 2, 5.0),
    ]


def test_the_bound_holds_for_all_together(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    calls: list[tuple[Any, ...]] = []
    never = float("inf")
    processes = [
        Fake(1, clock, calls, leaves_after_s=never, dies_after_s=0.1),
        Fake(2, clock, calls, leaves_after_s=2.0),
        Fake(3, clock, calls, leaves_after_s=never),
    ]
    assert end(processes, 3.0) == {1, 3}
    assert [call for call in calls if call[0] == "wait"] == [
        ("wait", 1, 3.0),
        ("wait", 2, 0.0),
        ("wait", 3, 0.0),
        ("wait", 1, 5.0),
        ("wait", 2, 5.0),
        ("wait", 3, 5.0),
    ]
    assert [call for call in calls if call[0] == "kill"] == [("kill", 1), ("kill", 3)]
    assert clock.now_s == pytest.approx(103.1)
    assert "module-1 (pid 1) did not leave within 3 s" in caplog.text


def test_no_process_gets_less_than_no_time_to_leave(clock: Clock) -> None:
    calls: list[tuple[Any, ...]] = []
    late = Fake(1, clock, calls)

    def terminate() -> None:
        clock.now_s += 1.0

    other = Fake(2, clock, calls)
    late.show = terminate  # type: ignore[method-assign]
    deadline_passed = Fake(3, clock, calls, leaves_after_s=9.0)
    wait = deadline_passed.wait

    def oversleep(timeout_s: float) -> bool:
        is_gone = wait(timeout_s)
        clock.now_s += 1.0
        return is_gone

    deadline_passed.wait = oversleep  # type: ignore[method-assign]
    end([deadline_passed, late, other], 0.5)
    assert ("wait", 2, 0.0) in calls


def test_a_process_that_survives_sigkill_is_reported(clock: Clock) -> None:
    calls: list[tuple[Any, ...]] = []
    hangs = Fake(1, clock, calls, leaves_after_s=99.0, dies_after_s=5.001)
    with pytest.raises(NotReadyError, match=r"module-1 \(pid 1\) survives SIGKILL"):
        end([Fake(2, clock, calls), hangs], 1.0)
    assert ("kill", 2) not in calls


# The end of a log


def read(path: Path, **options: int) -> tuple[str, ...]:
    return process_module.read_tail(path, **({"lines": 3} | options))


def test_the_tail_of_no_file_is_empty(tmp_path: Path) -> None:
    assert read(tmp_path / "none") == ()


def test_the_tail_has_the_last_lines_after_an_offset(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"one\ntwo\nthree \xff\nfour\nfive")
    assert read(path) == ("three �", "four", "five")
    assert read(path, lines=10) == ("one", "two", "three �", "four", "five")
    assert read(path, lines=10, offset=4) == ("two", "three �", "four", "five")
    assert read(path, offset=500) == ()


LIMIT = 64 * 1024


def test_the_tail_of_a_long_log_begins_with_a_whole_line(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"a" * LIMIT + b"\n" + b"b" * 100 + b"\n")
    assert read(path) == ("b" * 100,)
    assert read(path, offset=LIMIT) == ("", "b" * 100), "the offset is where a line begins"


def test_a_single_line_that_is_too_long_is_cut_and_not_lost(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"a" * (LIMIT + 5))
    assert read(path) == ("a" * LIMIT,)


def test_a_log_as_long_as_what_is_read_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"one\n" + b"a" * (LIMIT - 4))
    assert read(path)[0] == "one"


def test_the_last_lines_of_a_process_are_fifteen(start: Spawn) -> None:
    process = start("for i in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17; do echo $i; done")
    assert process.wait(SOON_S)
    assert process.last_lines() == tuple(str(i) for i in range(3, 18))
