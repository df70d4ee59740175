"""Which command reaches the driver, and for how long; on a test clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import pytest
from robot_cell import ARM, SOON_S, TIMEOUT_S, Cell, MakeHost
from sensor_msgs.msg import JointState

from roboneuron.contract import JointCommand, JointSample
from roboneuron.errors import UnsafeError
from roboneuron.modules.worker import LIMIT_S
from roboneuron.ros.messages import to_joint_state, to_joint_trajectory

pytestmark = pytest.mark.usefixtures("no_threads")


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def test_a_command_reaches_the_driver_in_its_own_time(cell: Cell) -> None:
    cell.command(0.3, step_s=0.25)
    cell.play()
    assert cell.sent == [(0.3, 0.25)]
    assert cell.told[0].names == ARM
    values = cell.host.values()
    assert values["note"] == "moving"
    assert cell.player.limit_s == 0.25 + LIMIT_S
    assert cell.player.calls == ["start", f"progress {0.25 + LIMIT_S:g}"]


def test_a_joint_state_is_a_command_too(cell: Cell) -> None:
    now_ns = cell.clock.wall_ns
    joints = JointSample(names=ARM, position=np.array([0.3, 0.1]), stamp_ns=now_ns)
    cell.receive(to_joint_state(joints))
    cell.play()
    assert cell.sent == [(0.3, 0.1)]


def test_a_trajectory_is_played_point_by_point(cell: Cell) -> None:
    cell.command(0.1, 0.2, 0.3, step_s=0.01)
    for _ in range(3):
        cell.play()
        cell.clock.go(0.01)
    assert cell.sent == [(0.1, 0.01), (0.2, 0.01), (0.3, 0.01)]
    cell.play()
    assert len(cell.sent) == 3


def test_the_next_point_waits_for_the_one_before(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=0.2)
    started_s = time.monotonic()
    cell.play()
    assert time.monotonic() - started_s >= 0.19


def test_the_last_point_is_not_waited_for(cell: Cell) -> None:
    """The next command is executed at once."""
    cell.command(0.1, step_s=60.0)
    started_s = time.monotonic()
    cell.play()
    assert time.monotonic() - started_s < SOON_S


def test_a_newer_trajectory_replaces_the_rest_of_the_older_one(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=60.0)
    timer = threading.Timer(0.05, cell.command, [-0.9])
    timer.start()
    started_s = time.monotonic()
    cell.play()
    timer.join()
    assert time.monotonic() - started_s < SOON_S, "it waits for the end of the older one"
    cell.play()
    assert cell.sent == [(0.1, 60.0), (-0.9, 0.1)]


def test_a_trajectory_that_is_replaced_while_it_is_sent_is_not_waited_for(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=60.0)
    cell.while_sending = lambda: cell.command(-0.9)
    started_s = time.monotonic()
    cell.play()
    assert time.monotonic() - started_s < SOON_S
    cell.while_sending = lambda: None
    cell.play()
    assert cell.sent == [(0.1, 60.0), (-0.9, 0.1)]


def test_the_end_of_the_thread_ends_the_wait_for_a_point(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=60.0)
    cell.while_sending = cell.player.end.set
    started_s = time.monotonic()
    cell.play()
    assert time.monotonic() - started_s < SOON_S


def test_nothing_is_played_when_the_thread_is_to_end(cell: Cell) -> None:
    cell.command(0.1)
    cell.player.end.set()
    cell.play()
    assert cell.told == []


def test_a_thread_without_commands_looks_again_soon(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot holds this soon after the timeout of commands."""
    waits_s: list[float] = []

    def wait_for(is_due: Callable[[], bool], timeout: float) -> bool:
        waits_s.append(timeout)
        return is_due()

    monkeypatch.setattr(cell.robot._arrived, "wait_for", wait_for)
    cell.play()
    assert waits_s == [0.05]
    assert cell.told == []


def test_a_command_that_is_played_late_has_that_much_more_time(cell: Cell) -> None:
    """Otherwise the arm would catch up, faster than requested."""
    cell.command(0.1, step_s=0.1)
    cell.clock.go(0.2)
    cell.play()
    assert cell.sent == [(0.1, 0.3)]


def test_a_point_is_late_against_the_end_of_the_one_before(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=0.05)
    cell.play()
    cell.clock.go(0.15)
    cell.play()
    assert cell.sent == [(0.1, 0.05), (0.2, 0.15)]


def test_a_point_that_is_played_early_keeps_its_time(cell: Cell) -> None:
    cell.command(0.1, 0.2, step_s=0.05)
    cell.play()
    cell.clock.go(0.01)
    cell.play()
    assert cell.sent == [(0.1, 0.05), (0.2, 0.05)]


def test_what_is_left_of_a_plan_that_is_past_is_not_executed(cell: Cell) -> None:
    """This process was frozen, or the driver did not return."""
    cell.command(0.1, 0.2)
    cell.clock.go(TIMEOUT_S + 1e-6)
    cell.play()
    assert cell.told == ["hold"]
    assert cell.host.drops() == {"stale_command": 1}
    cell.play()
    assert cell.told == ["hold"]


def test_a_command_as_late_as_the_timeout_is_still_executed(make_host: MakeHost) -> None:
    """0.25 s are exact in binary."""
    cell = Cell(make_host, replace={"command_timeout_s = 0.3": "command_timeout_s = 0.25"})
    cell.command(0.1, step_s=0.125)
    cell.clock.go(0.25)
    cell.play()
    assert cell.sent == [(0.1, 0.375)]


def test_a_command_may_be_as_old_as_the_timeout(cell: Cell) -> None:
    cell.command(0.1, age_s=TIMEOUT_S)
    assert cell.host.drops() == {}
    cell.command(0.2, age_s=TIMEOUT_S + 1e-6)
    assert cell.host.drops() == {"stale_command": 1}
    cell.play()
    assert cell.sent == [(0.1, 0.1)]
    assert list(cell.host.status.latency) == pytest.approx([300.0])


def test_a_command_that_is_a_nanosecond_too_old_is_stale(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={"command_timeout_s = 0.3": "command_timeout_s = 2.0"})
    message = to_joint_state(JointSample(names=ARM, position=np.array([0.3, 0.1]), stamp_ns=1))
    on_command = cell.host.subscribed[JointState, "joint_command"]
    on_command(message, {"source_timestamp": cell.clock.wall_ns - 2_000_000_001})
    assert cell.host.drops() == {"stale_command": 1}


def test_a_command_may_come_from_a_clock_that_is_a_little_ahead(cell: Cell) -> None:
    cell.command(0.1, age_s=-0.1)
    assert cell.host.drops() == {}
    cell.command(0.2, age_s=-0.1 - 1e-6)
    assert cell.host.drops() == {"future_command": 1}


@pytest.mark.parametrize(
    ("positions", "reason"),
    [
        ([float("nan"), 0.0], "not_finite"),
        ([0.1], "malformed_command"),
        ([0.1, 0.2, 0.3], "malformed_command"),
    ],
)
def test_a_damaged_command_is_counted_and_leaves_the_one_before(
    cell: Cell, positions: list[float], reason: str
) -> None:
    cell.command(0.1)
    message = to_joint_trajectory(
        JointCommand(names=ARM, position=np.array([0.5, 0.0]), duration_s=0.1)
    )
    message.points[0].positions = positions
    cell.receive(message)
    assert cell.host.drops() == {reason: 1}
    assert cell.host.values()["refused"].startswith(reason)
    assert not cell.host.values().get("error"), "any node may send it"
    cell.play()
    assert cell.sent == [(0.1, 0.1)]


def test_a_command_that_the_driver_refuses_is_counted_and_told(cell: Cell) -> None:
    def refuse(command: JointCommand) -> JointCommand:
        raise UnsafeError("beyond the joint's travel")

    cell.driver.send = refuse
    cell.command(0.1)
    cell.play()
    assert cell.host.drops() == {"refused_command": 1}
    assert "beyond the joint's travel" in cell.host.values()["error"]
    assert cell.host.values().get("note", "") == ""
    cell.clock.go(9.0)
    cell.play()
    assert cell.holds == 0, "nothing moves that could be held"


@pytest.mark.parametrize("error", [UnsafeError, RuntimeError])
def test_after_a_refused_point_the_arm_holds_and_the_others_are_not_sent(
    cell: Cell, error: type[Exception]
) -> None:
    send = cell.driver.send

    def refuse_the_second(command: JointCommand) -> JointCommand:
        if command.position[0] == 0.2:
            raise error("too late")
        return cast(JointCommand, send(command))

    cell.driver.send = refuse_the_second
    cell.command(0.1, 0.2, 0.3, step_s=0.01)
    for _ in range(3):
        cell.play()
        cell.clock.go(0.01)
    assert cell.sent == [(0.1, 0.01)]
    assert cell.holds == 1
    assert cell.host.drops() == {"refused_command": 1}
    cell.command(0.4)
    cell.play()
    assert cell.sent[1:] == [(0.4, 0.1)]


class Ahead:
    """A driver that accepts points before their time."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.given: list[list[float]] = []

    def send_ahead(self, command: JointCommand, planned: Sequence[JointCommand]) -> JointCommand:
        self.given.append([float(one.position[0]) for one in planned])
        return self.cell.send(command)


@pytest.fixture
def ahead(cell: Cell) -> Ahead:
    made = Ahead(cell)
    cell.driver.send_ahead = made.send_ahead
    return made


def test_points_are_given_ahead_and_again_when_they_are_due(cell: Cell, ahead: Ahead) -> None:
    cell.command(0.1, 0.2, 0.3, step_s=0.01)
    for _ in range(3):
        cell.play()
        cell.clock.go(0.01)
    assert cell.sent == [(0.1, 0.01), (0.2, 0.01), (0.3, 0.01)]
    assert ahead.given == [[0.2, 0.3], [0.3]]


def test_a_stop_leaves_no_point_to_be_given(cell: Cell, ahead: Ahead) -> None:
    cell.command(0.1, 0.2, 0.3, step_s=0.01)
    cell.play()
    cell.host.stopped = True
    cell.robot.stop("emergency_stop")
    cell.clock.go(0.01)
    cell.play()
    assert ahead.given == [[0.2, 0.3]]
    assert cell.told[-1] == "hold"
    assert len(cell.told) == 2


def test_a_stop_while_points_are_given_is_followed_by_a_hold(cell: Cell, ahead: Ahead) -> None:
    cell.command(0.1, 0.2, step_s=0.01)
    cell.while_sending = lambda: setattr(cell.host, "stopped", True)
    cell.play()
    assert ahead.given == [[0.2]]
    assert cell.told[-1] == "hold"
