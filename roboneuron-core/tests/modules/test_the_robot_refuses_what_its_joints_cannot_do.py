"""Commands beyond the joints do not reach the driver, whoever sends them; on a test clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from robot_cell import ARM, Cell, MakeHost
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointSample, RobotState
from roboneuron.errors import ConfigurationError, NotReadyError

pytestmark = pytest.mark.usefixtures("no_threads")
PAIR = 'name = "pair"'


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    """At rest at 0, with limits of 1 rad, 1 rad/s and 1 rad/s^2."""
    return Cell(make_host, robot=PAIR)


def trajectory(
    *points: tuple[float, float, float], names: tuple[str, ...] = ARM, stamp_s: int = 0
) -> JointTrajectory:
    """Points of time [s] and two positions."""
    message = JointTrajectory(joint_names=list(names))
    message.header.stamp.sec = stamp_s
    for at_s, *position in points:
        point = JointTrajectoryPoint(positions=position)
        seconds = math.floor(at_s)
        point.time_from_start.sec = seconds
        point.time_from_start.nanosec = round((at_s - seconds) * 1e9)
        message.points.append(point)
    return message


def state(*position: float, names: tuple[str, ...] = ARM, stamp_s: int = 0) -> JointState:
    message = JointState(name=list(names), position=list(position))
    message.header.stamp.sec = stamp_s
    return message


WALL_S = 1_700_000_000
HOSTILE: list[tuple[str, JointTrajectory | JointState, str]] = [
    ("nan", trajectory((0.1, math.nan, 0.0)), "not_finite"),
    ("inf", trajectory((0.1, 0.0, -math.inf)), "not_finite"),
    ("nan later", trajectory((0.1, 0.0, 0.0), (0.2, math.nan, 0.0)), "not_finite"),
    ("state nan", state(math.nan, 0.0), "not_finite"),
    ("huge", trajectory((0.1, 1e308, 0.0)), "limit_position"),
    ("state huge", state(0.0, -1e12), "limit_position"),
    ("beyond", trajectory((9.0, 1.01, 0.0)), "limit_position"),
    ("beyond later", trajectory((2.0, 0.5, 0.0), (9.0, 0.5, -1.2)), "limit_position"),
    ("jump", trajectory((0.1, 0.9, 0.0)), "joint_jump"),
    ("jump later", trajectory((0.1, 0.0, 0.0), (0.2, 0.9, 0.0)), "joint_jump"),
    ("state jump", state(0.9, 0.0), "joint_jump"),
    ("unknown", trajectory((0.1, 0.0, 0.0), names=("a", "c")), "unknown_joint"),
    ("state unknown", state(0.0, 0.0, names=("a", "\x1b[2J")), "unknown_joint"),
    ("no names", trajectory((0.1, 0.0, 0.0), names=()), "malformed_command"),
    ("one missing", trajectory((0.1, 0.0, 0.0), names=("a",)), "malformed_command"),
    ("twice", trajectory((0.1, 0.0, 0.0), names=("a", "a")), "malformed_command"),
    ("state twice", state(0.0, 0.0, names=("a", "a")), "malformed_command"),
    ("empty state", state(names=()), "malformed_command"),
    ("no points", trajectory(), "malformed_command"),
    ("no time", trajectory((0.0, 0.0, 0.0)), "malformed_command"),
    ("negative", trajectory((-0.5, 0.0, 0.0)), "malformed_command"),
    ("back", trajectory((0.2, 0.0, 0.0), (0.1, 0.0, 0.0)), "malformed_command"),
    ("long", trajectory(*[(0.1 * k, 0.0, 0.0) for k in range(1, 2002)]), "too_many_points"),
    ("stamped long ago", trajectory((0.1, 0.0, 0.0), stamp_s=WALL_S - 1), "stale_command"),
    ("simulated time", state(0.0, 0.0, stamp_s=12), "stale_command"),
    ("stamped ahead", trajectory((0.1, 0.0, 0.0), stamp_s=WALL_S + 1), "future_command"),
]


@pytest.mark.parametrize(
    ("message", "reason"), [row[1:] for row in HOSTILE], ids=[row[0] for row in HOSTILE]
)
def test_a_hostile_command_is_counted_by_reason_and_disturbs_nobody(
    cell: Cell, message: JointTrajectory | JointState, reason: str
) -> None:
    cell.host.foreign = "/intruder"
    cell.command(0.01, step_s=0.2)
    cell.receive(message)
    assert cell.host.drops() == {reason: 1}
    values = cell.host.values()
    assert values["refused"].startswith(f"{reason}: ")
    assert values["refused"].endswith("It may come from /intruder.")
    assert values["refused"].isprintable()
    assert not values.get("error"), "nothing is wrong with the robot"
    cell.play()
    assert cell.sent == [(0.01, 0.2)], "the command before it goes on"


def test_senders_are_named_only_if_they_are_foreign(cell: Cell) -> None:
    cell.receive(state(0.9, 0.0))
    assert "come from" not in cell.host.values()["refused"]


def test_refusals_are_told_at_most_once_a_second(cell: Cell) -> None:
    told: list[str] = []
    for _ in range(30):
        cell.receive(state(0.9, 0.0))
        cell.receive(state(math.nan, 0.0))
        told.append(cell.host.values()["refused"])
        cell.clock.go(0.1)
    assert cell.host.drops() == {"joint_jump": 30, "not_finite": 30}
    assert len(set(told)) == 1, "the first of each second"


@pytest.mark.parametrize("names", [("b", "a"), ("a", "b")])
def test_the_order_of_joints_is_the_sender_s(cell: Cell, names: tuple[str, ...]) -> None:
    position = [0.02 if name == "a" else -0.01 for name in names]
    cell.receive(trajectory((0.5, *position), names=names))
    cell.play()
    (command,) = cell.told
    assert dict(zip(command.names, command.position, strict=True)) == {"a": 0.02, "b": -0.01}


def test_a_command_for_some_joints_leaves_the_others(cell: Cell) -> None:
    message = JointTrajectory(joint_names=["b"])
    point = JointTrajectoryPoint(positions=[0.02])
    point.time_from_start.sec = 1
    message.points.append(point)
    cell.receive(message)
    cell.play()
    assert cell.told[0].names == ("b",)


def test_what_is_a_little_too_fast_reaches_the_driver_with_more_time(cell: Cell) -> None:
    cell.command(0.15, step_s=0.1)
    cell.play()
    ((place, duration_s),) = cell.sent
    assert place == 0.15
    assert duration_s == pytest.approx(math.sqrt(0.15), rel=1e-4)
    values = cell.host.values()
    assert values["limited.velocity"] == "1"
    assert values["limited.acceleration"] == "1"
    assert "acceleration" in values["limit"]


def test_points_given_ahead_are_within_the_limits(cell: Cell) -> None:
    given: list[Any] = []
    cell.driver.send_ahead = lambda command, planned: given.extend(planned) or command
    cell.receive(trajectory((1.0, 0.02, 0.0), (1.05, 0.15, 0.0)))
    cell.play()
    (later,) = given
    assert later.position[0] == 0.15
    assert later.duration_s > 0.13


def test_the_joints_are_read_when_a_command_comes_before_the_first_state(cell: Cell) -> None:
    cell.driver.position = np.array([0.5, 0.0])
    cell.command(0.52, step_s=0.5)
    cell.play()
    assert cell.sent == [(0.52, 0.5)]


def test_without_measured_joints_nothing_is_sent(cell: Cell) -> None:
    def read() -> RobotState:
        raise NotReadyError("The joint states have ceased.")

    cell.driver.read = read
    cell.command(0.01)
    assert cell.host.drops() == {"not_measured": 1}
    cell.play()
    assert cell.told == []


def test_a_point_that_has_become_a_jump_is_not_sent(cell: Cell) -> None:
    """The arm was moved between the arrival of a trajectory and the time of its second point."""
    cell.receive(trajectory((0.01, 0.005, 0.0), (0.02, 0.01, 0.0)))
    cell.play()
    joints = JointSample(names=ARM, position=np.array([-0.6, 0.0]))
    cell.driver.read = lambda: RobotState(joints=joints)
    cell.robot._guard.limits.measure(joints)
    cell.clock.go(0.01)
    cell.play()
    assert cell.sent == [(0.005, pytest.approx(math.sqrt(0.005), rel=1e-4))]
    assert cell.holds == 0
    assert cell.host.drops() == {"joint_jump": 1}


def test_an_arm_whose_time_waits_for_commands_has_always_reached_the_last_one(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, robot=PAIR)
    cell.driver.waits_for_commands = True
    place = 0.0
    for _ in range(5):
        cell.command(place := place + 0.01, step_s=0.1)
        cell.play()
        cell.driver.position = np.array([place, 0.0])
        cell.clock.go(0.001)
    assert cell.sent == [(pytest.approx(0.01 * k), 0.1) for k in range(1, 6)]


@pytest.mark.parametrize("tightened", [True, False])
def test_the_tightened_acceleration_holds_from_the_start(
    make_host: MakeHost, tightened: bool
) -> None:
    limits = LimitsConfig(acceleration_fraction=0.25) if tightened else None
    cell = Cell(make_host, robot=PAIR, tightened=limits)
    cell.command(0.04, step_s=0.2)
    cell.play()
    expected_s = math.sqrt(0.04 / 0.25) if tightened else 0.2
    assert cell.sent == [(0.04, pytest.approx(expected_s, rel=1e-4))]


def test_limits_are_changed_while_the_robot_runs_but_never_widened(make_host: MakeHost) -> None:
    cell = Cell(make_host, robot=PAIR, extra="[limits]\nacceleration_fraction = 0.5\n")
    use: Callable[[LimitsConfig], None] = cell.robot.use_limits
    use(LimitsConfig(acceleration_fraction=0.25))
    cell.command(0.04, step_s=0.2)
    cell.play()
    assert cell.sent == [(0.04, pytest.approx(0.4, rel=1e-4))]
    with pytest.raises(ConfigurationError):
        use(LimitsConfig(acceleration_fraction=0.6))


def test_after_a_stop_a_command_begins_at_rest(cell: Cell) -> None:
    cell.command(0.2, step_s=1.0)
    cell.play()
    cell.clock.go(0.5)
    cell.driver.position = np.array([0.1, 0.0])
    cell.reader.run()
    cell.robot.stop("emergency_stop")
    cell.command(0.12, step_s=0.1)
    cell.play()
    place, duration_s = cell.sent[-1]
    assert place == 0.12
    assert duration_s == pytest.approx(math.sqrt(0.02), rel=1e-3)


def test_a_command_is_judged_by_the_state_that_was_published_last(cell: Cell) -> None:
    def read() -> RobotState:
        raise NotReadyError("The joint states have ceased.")

    cell.reader.run()
    cell.driver.read = read
    cell.command(0.01)
    assert cell.host.drops() == {}
    with pytest.raises(NotReadyError):  # its thread reports it
        cell.reader.run()
    cell.command(0.01)
    assert cell.host.drops()["not_measured"] == 1
