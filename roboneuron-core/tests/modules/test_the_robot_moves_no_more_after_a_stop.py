"""A stop drops pending commands and holds the driver; on a test clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest
from robot_cell import SERVER_TIMEOUT_S, SOON_S, Cell, MakeHost

pytestmark = pytest.mark.usefixtures("no_threads")


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


STOPS: dict[str, Callable[[Cell], None]] = {
    "emergency_stop": lambda cell: setattr(cell.host, "stopped", True),
    "server_silent": lambda cell: setattr(cell.host, "silence_s", SERVER_TIMEOUT_S + 0.001),
    "needs_new_start": lambda cell: setattr(cell.host, "needs_start", "a stop"),
}


@pytest.mark.parametrize("word", STOPS)
def test_no_command_is_taken_after_a_stop(cell: Cell, word: str) -> None:
    STOPS[word](cell)
    before = cell.host.drops().get(word, 0)
    cell.command(0.1)
    cell.play()
    assert cell.told == []
    assert cell.host.drops() == {word: before + 1}


def test_the_emergency_stop_is_told_before_a_silent_server(cell: Cell) -> None:
    STOPS["server_silent"](cell)
    cell.host.stopped = True
    cell.command(0.1)
    assert cell.host.drops()["emergency_stop"] == 1


@pytest.mark.parametrize("word", STOPS)
def test_a_stop_while_a_command_is_sent_is_followed_by_a_hold(cell: Cell, word: str) -> None:
    """The stop's own hold came before the command."""
    cell.while_sending = lambda: STOPS[word](cell)
    cell.command(0.1, 0.2)
    for _ in range(2):  # pending commands are dropped, though nothing told the module to stop
        cell.play()
    assert cell.host.values().get("note", "") == ""
    cell.clock.go(9.0)
    cell.play()
    assert [type(one).__name__ for one in cell.told] == ["JointCommand", "str"]


def test_an_emergency_stop_holds_at_once_and_drops_what_was_to_come(cell: Cell) -> None:
    cell.command(0.1, 0.2)
    cell.robot.stop("emergency_stop")
    assert cell.told == ["hold"]
    cell.play()
    assert cell.told == ["hold"]


def test_the_release_of_a_stop_does_nothing(cell: Cell) -> None:
    cell.command(0.1)
    cell.robot.emergency_stop(False)
    assert cell.told == []
    cell.play()
    assert cell.sent == [(0.1, 0.1)]


def test_an_emergency_stop_ends_the_wait_for_a_point(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=60.0)
    timer = threading.Timer(0.05, cell.robot.stop, ["emergency_stop"])
    timer.start()
    started_s = time.monotonic()
    cell.play()
    timer.join()
    assert time.monotonic() - started_s < SOON_S
    cell.play()
    assert cell.sent == [(0.1, 60.0)]


def test_what_was_to_come_is_forgotten_after_a_stop(cell: Cell) -> None:
    cell.command(0.1)
    cell.robot.stop("needs_new_start")
    cell.play()
    assert cell.told == []


def test_a_silent_server_holds_the_robot_and_drops_what_was_to_come(cell: Cell) -> None:
    cell.command(0.1)
    cell.host.needs_start = "the server gave no sign of life"
    cell.robot.stop("server_silent")
    assert cell.told == ["hold"]
    assert cell.host.values()["note"] == "holding: the server gave no sign of life"
    cell.host.needs_start = ""
    cell.play()
    assert cell.told == ["hold"]
    cell.command(0.2)
    cell.play()
    assert cell.sent == [(0.2, 0.1)]


def test_the_server_is_silent_after_its_timeout(cell: Cell) -> None:
    cell.host.silence_s = SERVER_TIMEOUT_S
    cell.command(0.1)
    cell.play()
    assert cell.sent == [(0.1, 0.1)]
    assert cell.host.drops() == {}
