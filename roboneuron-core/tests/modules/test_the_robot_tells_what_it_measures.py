"""Measured states, details and faults; on a test clock."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from robot_cell import ARM, Cell, MakeHost

from roboneuron.contract import JointCommand, JointSample, RobotState
from roboneuron.errors import NotReadyError
from roboneuron.modules import robot as robot_module

pytestmark = pytest.mark.usefixtures("no_threads")


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def state(**changes: Any) -> RobotState:
    joints = JointSample(names=ARM, position=np.array([0.1, 0.2]), stamp_ns=5)
    values: dict[str, Any] = {"joints": joints, "gripper_open": 0.5, "detail": {"mood": "fine"}}
    return RobotState(**(values | changes))


def read(cell: Cell, **changes: Any) -> None:
    """Let the driver measure and the module publish."""
    cell.driver.read = lambda: state(**changes)
    cell.reader.run()


def test_a_measured_state_is_published_and_makes_the_robot_ready(cell: Cell) -> None:
    read(cell)
    (message,) = cell.host.publishers["joint_states"].messages
    assert (list(message.name), list(message.position)) == (list(ARM), [0.1, 0.2])
    values = cell.host.values()
    assert values["ready"] == "true"
    assert values["detail.mood"] == "fine"
    assert cell.host.status.output.total == 1


def test_states_are_told_to_features_as_often_as_details(cell: Cell) -> None:
    told: list[RobotState | None] = []
    cell.robot.on_state.append(told.append)
    read(cell)
    read(cell)
    assert [one.gripper_open for one in told if one is not None] == [0.5]


def test_details_are_told_ten_times_a_second(cell: Cell) -> None:
    read(cell)
    for mood in ("odd", "better"):
        cell.clock.go(0.0999)
        read(cell, detail={"mood": mood})
    assert cell.host.values()["detail.mood"] == "better"
    cell.clock.go(0.05)
    read(cell, detail={"mood": "too soon"})
    assert cell.host.values()["detail.mood"] == "better"
    assert len(cell.host.publishers["joint_states"].messages) == 4


def test_a_detail_period_must_have_passed(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_module, "_DETAIL_PERIOD_S", 0.125)
    read(cell)
    cell.clock.go(0.125)
    read(cell, detail={"mood": "too soon"})
    assert cell.host.values()["detail.mood"] == "fine"


def test_the_first_details_are_told_soon_after_the_machine_was_started(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, activate=False)
    cell.clock.now_s = 0.2
    cell.robot.activate()
    read(cell)
    assert cell.host.values()["detail.mood"] == "fine"


@pytest.mark.parametrize("now_s", [0.5, 1000.0])
def test_what_was_true_is_forgotten_when_the_robot_cannot_be_read(
    make_host: MakeHost, now_s: float
) -> None:
    """Shortly after the machine's boot, too."""
    cell = Cell(make_host, activate=False)
    cell.clock.now_s = now_s
    cell.robot.activate()
    read(cell)
    told: list[RobotState | None] = []
    cell.robot.on_state.append(told.append)

    def fail() -> RobotState:
        raise NotReadyError("The joint states have ceased.")

    cell.driver.read = fail
    with pytest.raises(NotReadyError):
        cell.reader.run()
    values = cell.host.values()
    assert "detail.mood" not in values
    assert told == [None]
    read(cell)
    assert cell.host.values()["detail.mood"] == "fine", "told again at once"


def test_states_are_published_at_the_configured_rate(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={'name = "pair"': 'name = "pair"\nstate_rate_hz = 100.0'})
    waits: list[float] = []
    cell.reader.end.wait = lambda s: s and waits.append(s)  # type: ignore[assignment]
    read(cell)
    assert waits == [], "the first one at once"
    cell.clock.go(0.004)
    read(cell)
    assert waits == pytest.approx([0.006])
    cell.clock.go(0.006)
    cell.clock.go(0.01)
    read(cell)
    assert waits == pytest.approx([0.006]), "it is due"


def test_after_a_pause_states_are_caught_up_for_a_twentieth_of_a_second(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, replace={'name = "pair"': 'name = "pair"\nstate_rate_hz = 100.0'})
    read(cell)
    cell.clock.go(1.0)
    read(cell)
    assert cell.robot._next_state_s == pytest.approx(cell.clock.now_s - 0.05)


def test_the_end_of_the_thread_ends_the_measuring(cell: Cell) -> None:
    cell.reader.end.set()
    read(cell)
    assert cell.host.publishers["joint_states"].messages == []


def test_a_fault_of_the_robot_needs_a_new_start_though_it_clears_itself(cell: Cell) -> None:
    read(cell, detail={"fault": "a reflex"})
    assert cell.host.needs_start == "a fault of the robot: a reflex"
    cell.host.needs_start = ""
    read(cell, detail={"fault": "a reflex"})
    assert cell.host.needs_start == "", "one fault is one stop"
    read(cell, detail={"fault": ""})
    assert cell.host.needs_start == ""
    read(cell, detail={"fault": "another"})
    assert cell.host.needs_start == "a fault of the robot: another"


def test_a_robot_without_faults_needs_no_new_start(cell: Cell) -> None:
    read(cell)
    assert cell.host.needs_start == ""


def test_commands_are_told_to_features_as_the_driver_has_sent_them(cell: Cell) -> None:
    told: list[JointCommand] = []
    cell.robot.on_sent.append(told.append)
    cell.command(0.1)
    cell.play()
    assert told == cell.told
