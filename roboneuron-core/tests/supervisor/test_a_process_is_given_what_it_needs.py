"""One child process: its environment, its input, and the end of its log.

The children are shells; no module and no ROS node is started.
"""

from __future__ import annotations

import os
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from shells import SOON_S, Spawn, await_line

from rn_testing.waiting import wait_until
from roboneuron.errors import NotReadyError
from roboneuron.log_files import read_tail
from roboneuron.supervisor.process import ProcessEvents, spawn

pytestmark = pytest.mark.timeout(60)


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


def read(path: Path, **options: int) -> tuple[str, ...]:
    return read_tail(path, **({"lines": 3} | options))


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
