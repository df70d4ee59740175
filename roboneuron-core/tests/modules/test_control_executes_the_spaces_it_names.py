"""Actions of other control spaces than TCP deltas; on a test clock."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from control_cell import START, Cell, MakeHost
from loop_plugin import profile
from std_msgs.msg import Float64MultiArray

from roboneuron.contract import ACTION_LABEL, Channel, ControlSpace, robot_space
from roboneuron.modules.control.module import _split
from roboneuron.ros.messages import to_action_message


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host, replace={'"adder"': '"mover"'})


def velocity(*row: float, kind: str = "joint_velocity", rate_hz: float = 10.0) -> Float64MultiArray:
    return to_action_message(np.array(row), robot_space(kind, profile(), rate_hz))


def executed(cell: Cell) -> list[Any]:
    controller: Any = cell.control.controller
    return controller.executed  # type: ignore[no-any-return]


def test_a_row_is_executed_in_the_space_of_its_label(cell: Cell) -> None:
    cell.receive(velocity(0.1, -0.05))
    ((space, row, joints, step_s),) = executed(cell)
    assert (space.kind, space.label) == ("joint_velocity", "joint_velocity@10:a,b")
    assert (row, step_s) == ([0.1, -0.05], 0.1)
    assert joints.position.tolist() == START.tolist()
    assert cell.commands[-1] == pytest.approx([0.51, -0.505])
    assert cell.asked == []


def test_displacements_of_the_tcp_are_executed_beside_it(cell: Cell) -> None:
    for message in (velocity(0.1, 0.0), None, velocity(0.1, 0.0)):
        if message is None:
            cell.act()
        else:
            cell.receive(message)
        cell.go(0.1)
    assert len(cell.asked) == 1
    assert len(executed(cell)) == 2
    assert cell.drops() == {}


def test_a_row_lasts_one_period_of_its_policy_whenever_it_arrives(cell: Cell) -> None:
    for rate_hz in (20.0, 25.0):
        cell.receive(velocity(0.1, 0.0, rate_hz=rate_hz))
        cell.go(0.1)
    assert [(space.rate_hz, step_s) for space, _, _, step_s in executed(cell)] == [
        (20.0, 0.05),
        (25.0, 0.04),
    ]


def test_velocities_add_to_the_command_in_progress(cell: Cell) -> None:
    """A measured arm lags, and would never get as far as requested."""
    cell.receive(velocity(0.1, 0.0))
    cell.go(0.05)
    cell.receive(velocity(0.1, 0.0))
    assert executed(cell)[1][2].position == pytest.approx([0.51, -0.5])
    cell.go(2.0)
    cell.receive(velocity(0.1, 0.0))
    assert executed(cell)[2][2].position == pytest.approx(START)


@pytest.mark.parametrize("kind", ["joint_position", "joint_delta"])
def test_a_space_that_control_does_not_execute_is_refused(cell: Cell, kind: str) -> None:
    """Inference resolves joint deltas; they are never sent."""
    cell.receive(velocity(0.1, 0.0, kind=kind))
    assert executed(cell) == []
    assert cell.drops() == {"malformed": 1}
    error = cell.host.values()["error"]
    assert f"An action is labelled '{kind}@10:a,b'" in error
    assert "'ee_delta_base', 'joint_velocity:a,b'" in error
    cell.receive(velocity(0.1, 0.0))
    assert len(executed(cell)) == 1


def test_the_first_velocity_needs_a_rate_too(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={'"adder"': '"glider"'})
    cell.receive(velocity(0.1, 0.0, rate_hz=0.0))
    assert executed(cell) == []
    assert cell.drops() == {"malformed": 1}
    cell.receive(velocity(0.1, 0.0))
    assert len(executed(cell)) == 1


@pytest.mark.parametrize("rate_hz", [0.0, 0.5, 12.5, 15.0, 1000.0])
def test_a_label_is_split_into_what_it_was_made_of(rate_hz: float) -> None:
    channels = (Channel(name="a", unit="rad"), Channel(name="b", unit="rad"))
    space = ControlSpace(kind="joint_velocity", channels=channels, rate_hz=rate_hz)
    assert _split(space.label) == ("joint_velocity:a,b", rate_hz)
    assert _split(ACTION_LABEL) == (ACTION_LABEL, 0.0)


@pytest.mark.parametrize("text", ["joint_position@fast:a", "joint_position@:a", "joint_position:a"])
def test_what_is_no_rate_counts_as_none(text: str) -> None:
    assert _split(text) == ("joint_position:a", 0.0)


@pytest.mark.parametrize("text", ["", ":", "@", "joint_position", "@:,", "ee_delta_base@5"])
def test_any_text_can_be_split(text: str) -> None:
    name, rate_hz = _split(text)
    assert "@" not in name
    assert rate_hz in (0.0, 5.0)
