"""The robot module creates, opens, holds and closes its driver in order; on a test clock."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from robot_cell import TIMEOUT_S, Cell, MakeHost
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.errors import ConfigurationError, NotReadyError
from roboneuron.modules.robot import RobotModule

pytestmark = pytest.mark.usefixtures("no_threads")


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


@pytest.mark.parametrize(
    ("new", "match"),
    [
        ('name = "triple"', "triple"),
        ('name = "pair"\ndriver = "none"', "no driver 'none'; choose one of: simulated"),
    ],
)
def test_a_robot_or_driver_that_is_not_there_is_refused(
    make_host: MakeHost, new: str, match: str
) -> None:
    with pytest.raises(ConfigurationError, match=match):
        RobotModule(make_host("robot", replace={'name = "pair"': new}))


def test_options_reach_the_driver(make_host: MakeHost) -> None:
    with pytest.raises(ConfigurationError, match="speed"):
        RobotModule(make_host("robot", extra="[plugins.pair]\nspeed = 3\n"))


def test_the_driver_is_given_the_robot_opened_and_closed_last(
    make_host: MakeHost, monkeypatch: pytest.MonkeyPatch
) -> None:
    import loop_plugin

    done: list[Any] = []

    class Driver(loop_plugin.Driver):  # type: ignore[misc]
        def __init__(self, config: object, profile: Any, topics: Any) -> None:
            super().__init__(config, profile, topics)
            done.append((config, profile.name, type(topics).__name__))

        def open(self) -> None:
            done.append("open")

        def close(self) -> None:
            done.append("close")

    monkeypatch.setattr(loop_plugin, "Driver", Driver)
    host = make_host("robot")
    robot = RobotModule(host)
    assert done == [(None, "pair", "NodeTopics"), "open"]
    host.resources.callback(done.append, "resources")
    for worker in (robot._reader, robot._player):
        worker.stop = lambda: done.append("stop")  # type: ignore[method-assign]
    robot._topics.close()
    host.resources.close()
    assert done[2:] == ["resources", "close"]


def test_topics_that_the_driver_was_lent_are_taken_back_at_the_end(cell: Cell) -> None:
    lent: list[str] = []
    cell.host.create_subscription = lambda kind, topic, deliver, qos: lent.append(topic) or topic
    cell.host.destroy_subscription = lent.remove
    cell.robot._topics.subscribe("switch", JointState, lambda message: None)
    assert lent == ["switch"]
    cell.host.resources.close()
    assert lent == []


def test_its_threads_end_before_the_driver_is_closed(cell: Cell) -> None:
    cell.driver.close = lambda: cell.told.append("close")
    cell.host.resources.close()
    assert cell.reader.calls[-1] == cell.player.calls[-1] == "stop"


def test_it_listens_and_publishes_under_the_names_of_the_contract(cell: Cell) -> None:
    assert set(cell.host.subscribed) == {
        (JointTrajectory, "joint_trajectory"),
        (JointState, "joint_command"),
    }
    assert cell.host.publishers["joint_states"].message_type is JointState
    assert cell.host.values()["driver"] == "simulated"
    assert (cell.reader.name, cell.player.name) == ("robot-state", "robot-command")
    assert cell.reader.status is cell.player.status is cell.host.status


def test_a_drivers_own_topics_are_heard_while_the_robot_may_move(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    accepts = cell.robot._topics._accepts
    assert not accepts()
    cell.robot.activate()
    assert accepts()
    cell.host.needs_start = "a stop"
    assert not accepts()


def test_the_driver_holds_once_when_commands_cease(cell: Cell) -> None:
    cell.command(0.1, step_s=0.1)
    cell.play()
    cell.clock.go(0.1 + TIMEOUT_S / 2)
    cell.play()
    cell.clock.go(TIMEOUT_S / 2 - 1e-6)
    cell.play()
    assert cell.holds == 0, "counted from the end of the last command"
    cell.clock.go(2e-6)
    cell.play()
    cell.play()
    assert cell.holds == 1
    assert cell.host.values()["note"] == "holding: no command"


@pytest.mark.parametrize(
    ("a_step", "first_hold"),
    [(0.05, None), (1e-3, None), (2e-4, 4), (0.0, 4), (-0.05, 4), (math.nan, 4)],
    ids=["late", "very late", "creeps", "stuck", "goes back", "unknown"],
)
def test_an_arm_that_is_late_is_not_held_while_it_comes_nearer(
    cell: Cell, a_step: float, first_hold: int | None
) -> None:
    cell.command(0.8, step_s=0.1)
    cell.play()
    cell.clock.go(0.1)
    held_at: int | None = None
    for tick in range(12):
        cell.driver.position = np.array([0.1 + tick * a_step, 0.0])
        cell.reader.run()
        cell.play()
        if cell.holds and held_at is None:
            held_at = tick
        cell.clock.go(TIMEOUT_S / 4 + 1e-6)
    assert held_at == first_hold
    assert cell.holds == (first_hold is not None)


def test_an_arm_that_is_late_and_measured_no_more_is_held(cell: Cell) -> None:
    cell.command(0.8, step_s=0.1)
    cell.play()
    cell.clock.go(0.1)
    cell.reader.run()
    cell.play()
    cell.driver.read = fails
    for _ in range(4):
        cell.clock.go(TIMEOUT_S / 4 + 1e-6)
        with pytest.raises(OSError, match="unplugged"):
            cell.reader.run()
        cell.play()
    assert cell.holds == 1


def test_an_arm_is_not_held_because_its_process_was_halted(cell: Cell) -> None:
    """Its simulation was halted as well, and has had no time to bring the arm nearer."""
    cell.command(0.8, step_s=0.1)
    cell.play()
    cell.clock.go(0.1)
    cell.reader.run()
    cell.play()
    for position in (0.1, 0.2, 0.3):
        cell.clock.go(20 * TIMEOUT_S)
        cell.play()
        assert cell.holds == 0
        cell.driver.position = np.array([position, 0.0])
        cell.reader.run()
        cell.clock.go(TIMEOUT_S / 4)
        cell.play()
        assert cell.holds == 0


def fails() -> Any:
    raise OSError("unplugged")


def test_commands_cease_just_after_the_timeout(make_host: MakeHost) -> None:
    """0.25 s are exact in binary."""
    cell = Cell(make_host, replace={"command_timeout_s = 0.3": "command_timeout_s = 0.25"})
    cell.command(0.1, step_s=0.25)
    cell.play()
    cell.clock.go(0.5)
    cell.play()
    assert cell.holds == 0


def test_a_robot_that_was_never_commanded_is_not_held(cell: Cell) -> None:
    cell.clock.go(9.0)
    cell.play()
    assert cell.holds == 0


def test_an_inactive_robot_takes_no_commands(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.command(0.1)
    assert cell.robot._pending == []
    assert cell.host.drops() == {}


def test_activating_starts_both_threads(cell: Cell) -> None:
    assert cell.reader.calls == cell.player.calls == ["start"]
    values = cell.host.values()
    assert values["ready"] == "false"
    assert values["waiting_for"] == "the first joint state from the driver"


def test_deactivating_holds_after_the_last_command_and_ends_both_threads(cell: Cell) -> None:
    cell.command(0.1)

    def stop() -> bool:
        assert not cell.robot._active
        assert cell.robot._pending == []
        cell.told.append("player ended")
        return True

    cell.player.stop = stop
    cell.robot.deactivate()
    assert cell.told == ["player ended", "hold"]
    assert cell.reader.calls == ["start", "stop"]
    cell.command(0.2)
    assert cell.robot._pending == []


@pytest.mark.parametrize("name", ["reader", "player"])
def test_a_thread_that_hangs_in_the_driver_is_told(cell: Cell, name: str) -> None:
    getattr(cell, name).ends = False
    with pytest.raises(NotReadyError, match="The driver hangs"):
        cell.robot.deactivate()
    assert cell.holds == 1
    assert cell.reader.calls == ["start", "stop"]
