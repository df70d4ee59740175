"""While the server or its control moves the arm, others are refused; on a test clock."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
from robot_cell import ARM, TIMEOUT_S, Cell, MakeHost
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron.ros.graph import server_node

pytestmark = pytest.mark.usefixtures("no_threads")
OURS, OTHER_SERVER, NOBODY = server_node(os.getppid()), server_node(1), ""


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def trajectory(first: float, sender: str, lasts_s: int = 1) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=[first, 0.0])
    point.time_from_start.sec = lasts_s
    message = JointTrajectory(joint_names=list(ARM), points=[point])
    message.header.frame_id = sender
    return message


def state(first: float, sender: str) -> JointState:
    message = JointState(name=list(ARM), position=[first, 0.0])
    message.header.frame_id = sender
    return message


@pytest.mark.parametrize("sender", [NOBODY, OTHER_SERVER, "base"])
@pytest.mark.parametrize("make", [trajectory, state])
def test_others_are_refused_until_the_claim_lapses(
    cell: Cell, sender: str, make: Callable[[float, str], JointTrajectory | JointState]
) -> None:
    cell.receive(trajectory(0.1, OURS))
    cell.clock.go(1.0 + TIMEOUT_S - 0.01)
    cell.receive(make(0.2, sender))
    assert cell.host.drops() == {"claimed": 1}
    cell.clock.go(0.02)
    cell.receive(make(0.2, sender))
    assert cell.host.drops() == {"claimed": 1}


def test_the_server_takes_the_arm_from_others_at_once(cell: Cell) -> None:
    cell.receive(trajectory(0.1, NOBODY))
    cell.receive(trajectory(0.2, OURS))
    cell.play()
    assert [position for position, _ in cell.sent] == [0.2]


def test_others_replace_each_other(cell: Cell) -> None:
    cell.receive(trajectory(0.1, NOBODY))
    cell.receive(trajectory(0.2, OTHER_SERVER))
    cell.play()
    assert [position for position, _ in cell.sent] == [0.2]


def test_a_command_that_is_refused_claims_nothing(cell: Cell) -> None:
    cell.receive(trajectory(float("nan"), OURS))
    cell.receive(trajectory(0.1, NOBODY))
    assert cell.host.drops() == {"not_finite": 1}


@pytest.mark.parametrize("code", ["emergency_stop", "stop_motion", "needs_new_start"])
def test_a_stop_ends_the_claim(cell: Cell, code: str) -> None:
    cell.receive(trajectory(0.1, OURS))
    cell.robot.stop(code)
    cell.receive(trajectory(0.2, NOBODY))
    assert cell.host.drops() == {}
