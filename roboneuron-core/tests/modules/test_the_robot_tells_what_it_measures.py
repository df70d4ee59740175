"""Measured states, details, faults and the commanded opening; on a clock of the test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from robot_cell import ARM, Cell, MakeHost

from roboneuron.contract import GripperProfile, JointCommand, JointSample, RobotState
from roboneuron.errors import NotReadyError
from roboneuron.modules import robot as robot_module
from roboneuron.ros.messages import to_joint_trajectory

pytestmark = pytest.mark.usefixtures("no_threads")


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def state(**changes: Any) -> RobotState:
    joints = JointSample(names=ARM, position=np.array([0.1, 0.2]), stamp_ns=5)
    values: dict[str, Any] = {"joints": joints, "gripper_open": 0.5, "detail": {"mood": "fine"}}
    return RobotState(**(values | changes))


def read(cell: Cell, **changes: Any) -> None:
    """The driver measures, and the module publishes."""
    cell.driver.read = lambda: state(**changes)
    cell.reader.run()


def test_a_measured_state_is_published_and_makes_the_robot_ready(cell: Cell) -> None:
    read(cell)
    (message,) = cell.host.publishers["joint_states"].messages
    assert (list(message.name), list(message.position)) == (list(ARM), [0.1, 0.2])
    values = cell.host.values()
    assert values["ready"] == "true"
    assert (values["detail.mood"], values["gripper_open"]) == ("fine", "0.5")
    assert cell.host.status.output.total == 1


def test_a_robot_without_a_gripper_tells_no_opening(cell: Cell) -> None:
    read(cell, gripper_open=None)
    assert "gripper_open" not in cell.host.values()


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
    """Soon after the machine was started, too."""
    cell = Cell(make_host, activate=False)
    cell.clock.now_s = now_s
    cell.robot.activate()
    read(cell)

    def fail() -> RobotState:
        raise NotReadyError("The joint states have ceased.")

    cell.driver.read = fail
    with pytest.raises(NotReadyError):
        cell.reader.run()
    values = cell.host.values()
    assert "detail.mood" not in values
    assert "gripper_open" not in values
    read(cell)
    assert cell.host.values()["detail.mood"] == "fine", "told again at once"


def test_states_are_published_at_the_configured_rate(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={'name = "pair"': 'name = "pair"\nstate_rate_hz = 100.0'})
    waits: list[float] = []
    cell.reader.end.wait = waits.append  # type: ignore[assignment]
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


GRIPPER = GripperProfile(joint="finger", open_position=0.04, closed_position=0.0)


@pytest.fixture
def gripped(make_host: MakeHost, monkeypatch: pytest.MonkeyPatch) -> Cell:
    import loop_plugin

    profile = replace(loop_plugin.profile(), gripper=GRIPPER)
    monkeypatch.setattr(loop_plugin, "profile", lambda: profile)
    return Cell(make_host)


def grip(cell: Cell, opening: float, *, names: tuple[str, ...] = (*ARM, "finger")) -> None:
    position = np.array([0.1, 0.2, 0.04 * opening])
    cell.receive(to_joint_trajectory(JointCommand(names=names, position=position, duration_s=0.1)))
    cell.play()


def test_the_commanded_opening_is_told_at_once_when_it_changes(gripped: Cell) -> None:
    changed = gripped.host.status.changed
    for opening, is_told in ((0.5, True), (0.51, False), (0.525, True), (0.525, False)):
        changed.clear()
        gripped.host.status.clear_error()
        grip(gripped, opening)
        assert float(gripped.host.values()["gripper_commanded"]) == pytest.approx(opening)
        assert changed.is_set() == is_told, opening


def test_a_change_of_the_opening_by_the_bound_itself_is_told_with_the_next_report(
    gripped: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0.25 is exact in binary."""
    monkeypatch.setattr(robot_module, "_GRIPPER_CHANGE", 0.25)
    grip(gripped, 0.5)
    gripped.host.status.changed.clear()
    grip(gripped, 0.75)
    assert gripped.host.values()["gripper_commanded"] == "0.75"
    assert not gripped.host.status.changed.is_set()


@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_any_opening_is_told_at_the_first_command(gripped: Cell, opening: float) -> None:
    gripped.host.status.changed.clear()
    grip(gripped, opening)
    assert gripped.host.status.changed.is_set()
    assert gripped.host.values()["gripper_commanded"] == f"{opening:g}"


def test_a_command_without_the_gripper_tells_no_opening(gripped: Cell) -> None:
    grip(gripped, 0.5, names=(*ARM, "thumb"))
    assert "gripper_commanded" not in gripped.host.values()


def test_a_robot_without_a_gripper_has_no_commanded_opening(cell: Cell) -> None:
    grip(cell, 0.5)
    assert "gripper_commanded" not in cell.host.values()
