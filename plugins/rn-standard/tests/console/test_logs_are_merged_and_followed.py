"""Logs of a run come in order of time, are followed over rotation and new runs, and cannot act on
the terminal.
"""

from __future__ import annotations

import io
import os
import signal
from pathlib import Path

import pytest
from rich.console import Console

from rn_standard.console import log_reading
from rn_standard.console.log_reading import LogView, choose_run
from rn_standard.console.log_runs import log_runs
from roboneuron.cli.main import main
from roboneuron.errors import ConfigurationError


def entry(second: int, text: str, level: str = "INFO") -> str:
    return f"2026-01-02 10:15:{second:02},000 {level} here: {text}\n"


@pytest.fixture
def state(tmp_path: Path) -> Path:
    run = tmp_path / "log" / "20260102-101500-42"
    run.mkdir(parents=True)
    (tmp_path / "log" / "ros").mkdir()
    (tmp_path / "log" / "20260101-101500-41").mkdir()
    (run / "server.log").write_text(entry(1, "one") + entry(3, "three"))
    (run / "robot.log").write_text(
        entry(2, "two", "ERROR") + "  File x\n" + entry(4, "\x1b[31mfour")
    )
    return tmp_path


def shown(state: Path, *words: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    assert main(["logs", "--state", str(state), *words]) == 0
    return capsys.readouterr().out.splitlines()[1:]


def test_lines_of_all_modules_are_in_order_of_time(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = shown(state, capsys=capsys)
    assert [line.split()[0] for line in lines] == ["server", "robot", "robot", "server", "robot"]
    assert [line.split()[-1] for line in lines] == ["one", "two", "x", "three", "\\x1b[31mfour"]
    assert shown(state, "-n", "2", capsys=capsys) == lines[-2:]


def test_one_modules_log_stands_as_it_is(state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        shown(state, "server", capsys=capsys) == (entry(1, "one") + entry(3, "three")).splitlines()
    )


def test_runs_are_listed_the_newest_first(state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["logs", "--state", str(state), "--runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["20260102-101500-42  robot, server", "20260101-101500-41  empty"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["control"], "has no log of control. It has: robot, server."),
        (["--run", "20250101-000000-1"], "There is no run '20250101-000000-1'."),
        (["--state", "/no/such"], "No server has logged below /no/such yet."),
    ],
)
def test_what_is_not_there_is_said_in_one_line(
    state: Path, words: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = [] if "--state" in words else ["--state", str(state)]
    assert main(["logs", *before, *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line


def test_following_shows_what_is_added_begun_anew_and_a_newer_run(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = choose_run(state, None)
    output = io.StringIO()
    view = LogView(run, None, Console(file=output, width=200, highlight=False, markup=False))
    view.show_last(1)

    def add() -> None:
        with (run.path / "robot.log").open("a") as file:
            file.write(entry(5, "five")[:-1])  # not yet a whole line

    def finish_and_rotate() -> None:
        with (run.path / "robot.log").open("a") as file:
            file.write("!\n")
        os.replace(run.path / "server.log", run.path / "server.log.1")
        (run.path / "server.log").write_text(entry(6, "six"))

    def begin_another_run() -> None:
        newer = state / "log" / "20260102-101600-43"
        newer.mkdir()
        (newer / "control.log").write_text(entry(7, "seven"))

    def end() -> None:
        raise KeyboardInterrupt

    steps = iter([add, finish_and_rotate, begin_another_run, lambda: None, end])
    monkeypatch.setattr(log_reading.time, "sleep", lambda _: next(steps)())
    with pytest.raises(KeyboardInterrupt):
        view.follow(state)
    words = [line.split()[-1] for line in output.getvalue().splitlines()]
    assert words[2:4] == ["five!", "six"]
    assert words[4].endswith("20260102-101600-43")
    assert words[5:] == ["seven"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_that_python_drops_ends_following(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while an object is being deleted: Python reports the exception and goes on."""

    class Deleted:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    view = LogView(choose_run(state, None), None, Console(file=io.StringIO()))
    steps = iter([Deleted, lambda: None, lambda: pytest.fail("it goes on")])
    monkeypatch.setattr(log_reading.time, "sleep", lambda _: next(steps)())
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        view.follow(state)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_folder_of_another_kind_is_no_run(state: Path) -> None:
    assert [run.pid for run in log_runs(state)] == [42, 41]
    with pytest.raises(ConfigurationError, match="No server has logged"):
        choose_run(state / "log", None)
