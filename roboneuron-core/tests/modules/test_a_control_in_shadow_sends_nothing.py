"""A control in shadow of another one computes everything and sends nothing."""

from __future__ import annotations

import numpy as np
import pytest
from control_cell import (
    ARM,
    Cell,
    MakeHost,
)
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import (
    JointCommand,
)
from roboneuron.errors import InvalidInputError
from roboneuron.ros.messages import to_joint_trajectory


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def test_in_shadow_everything_is_worked_out_and_nothing_sent(make_host: MakeHost) -> None:
    cell = Cell(make_host, is_successor=True)
    cell.act()
    for _ in range(2):
        cell.go(0.001)
    withheld = [type(one).__name__ for one in cell.host.handover.withheld]
    assert withheld == ["Pose", "JointCommand", "Pose", "Pose"], "every state is answered"
    assert (cell.commands, cell.poses, cell.host.handover.sent) == ([], [], [])
    assert cell.host.values()["ready"] == "true"
    cell.control.stop("emergency_stop")
    assert cell.commands == []
    assert cell.code == ""


def test_what_is_the_successors_is_left_to_it(cell: Cell) -> None:
    cell.act()
    cell.host.handover.set("act_until_ns", cell.clock.wall_ns + 1)
    cell.go(0.03)
    cell.act()
    assert len(cell.asked) == 1
    assert len(cell.poses) == 1
    assert cell.drops() == {}
    cell.go(1.0)
    cell.watch()
    cell.control.deactivate()
    assert len(cell.commands) == 1
    assert cell.code == ""


def test_a_successor_goes_on_from_the_predecessors_command(cell: Cell) -> None:
    command = JointCommand(names=ARM, position=np.array([0.52, -0.5]), duration_s=0.1)
    sent_s = cell.clock.now_s - 0.05
    taken = cell.control.follow(to_joint_trajectory(command), sent_s)
    assert taken.position.tolist() == [0.52, -0.5]
    sent = cell.control._limiter._sent
    assert sent is not None
    assert sent.sent_s == sent_s
    assert sent.displacement == pytest.approx([0.02, 0.0])
    cell.watch()
    assert cell.commands == []
    cell.go(0.18)
    cell.watch()
    assert cell.code == "no_action", "counted from the predecessor's command"


def test_a_predecessors_command_is_read_and_changes_nothing_after_the_first_of_ones_own(
    cell: Cell,
) -> None:
    cell.act()
    sent, acted_s = cell.control._limiter._sent, cell.control.action_s
    command = JointCommand(names=ARM, position=np.array([0.6, -0.5]), duration_s=0.1)
    assert cell.control.follow(to_joint_trajectory(command), 1.0).position[0] == 0.6
    assert cell.control._limiter._sent is sent
    assert cell.control.action_s == acted_s


def test_a_predecessors_command_before_the_arm_was_measured_is_only_read(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, activate=False)
    command = JointCommand(names=ARM, position=np.array([0.6, -0.5]), duration_s=0.1)
    assert cell.control.follow(to_joint_trajectory(command), 1.0).position[0] == 0.6
    assert cell.control._limiter._sent is None
    assert cell.control.is_holding


def test_a_malformed_command_of_the_predecessor_is_refused(cell: Cell) -> None:
    with pytest.raises(InvalidInputError):
        cell.control.follow(JointTrajectory(), 1.0)
