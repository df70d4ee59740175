"""The robot module on a clock of the test: which command reaches the driver, for how long, and when
the driver holds.

Its threads are not started: the test calls their steps.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron.contract import GripperProfile, JointCommand, JointSample, RobotState
from roboneuron.errors import ConfigurationError, NotReadyError, UnsafeError
from roboneuron.modules import robot as robot_module
from roboneuron.modules.robot import RobotModule
from roboneuron.modules.worker import LIMIT_S
from roboneuron.ros.messages import to_joint_state, to_joint_trajectory

ARM = ("a", "b")
MakeHost = Callable[..., Any]
TIMEOUT_S, SERVER_TIMEOUT_S = 0.3, 2.0
SOON_S = 15.0
"""Milliseconds on an idle machine."""


class Steps:
    """Stands for a worker: knows the step, and runs it when told."""

    def __init__(self, name: str, step: Callable[[threading.Event], None], status: object) -> None:
        self.name, self.step, self.status = name, step, status
        self.limit_s = LIMIT_S
        self.calls: list[str] = []
        self.ends = True
        self.end = threading.Event()

    def start(self) -> None:
        self.calls.append("start")

    def stop(self) -> bool:
        self.calls.append("stop")
        return self.ends

    def progress(self) -> None:
        self.calls.append(f"progress {self.limit_s:g}")

    def run(self) -> None:
        self.step(self.end)


class Cell:
    """A robot module whose driver keeps what it is told, in order."""

    def __init__(self, make_host: MakeHost, *, activate: bool = True, **options: Any) -> None:
        self.host = make_host("robot", **options)
        self.host.create_publisher = None
        self.clock = self.host.clock
        self.robot = RobotModule(self.host)
        self.told: list[Any] = []
        self.driver: Any = self.robot.driver
        self.driver.send = self.send
        self.driver.hold = lambda: self.told.append("hold")
        self.while_sending: Callable[[], object] = lambda: None
        self.reader: Any = self.robot._reader
        self.player: Any = self.robot._player
        if activate:
            self.robot.activate()

    def send(self, command: JointCommand) -> JointCommand:
        self.told.append(command)
        self.while_sending()
        return command

    def command(self, *firsts: float, step_s: float = 0.1, age_s: float = 0.0) -> None:
        """A trajectory arrives: the first joint goes to these, each within `step_s`."""
        message = JointTrajectory(joint_names=list(ARM))
        for index, first in enumerate(firsts):
            point = JointTrajectoryPoint(positions=[first, 0.0])
            at_ns = round((index + 1) * step_s * 1e9)
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(at_ns, 10**9)
            message.points.append(point)
        self.receive(message, age_s)

    def receive(self, message: JointTrajectory | JointState, age_s: float = 0.0) -> None:
        topic = "joint_trajectory" if isinstance(message, JointTrajectory) else "joint_command"
        self.host.subscribed[type(message), topic](
            message, {"source_timestamp": self.clock.wall_ns - round(age_s * 1e9)}
        )

    def play(self) -> None:
        self.player.run()

    def watch(self) -> None:
        self.host.repeated[0][1]()

    @property
    def sent(self) -> list[tuple[float, float]]:
        """Position of the first joint, and duration, of each command to the driver."""
        return [
            (float(one.position[0]), round(one.duration_s, 6))
            for one in self.told
            if isinstance(one, JointCommand)
        ]

    @property
    def holds(self) -> int:
        return self.told.count("hold")


@pytest.fixture(autouse=True)
def _no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_module, "Worker", Steps)


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


# How it is made


@pytest.mark.parametrize(
    ("new", "match"),
    [
        ('name = "triple"', "triple"),
        ('name = "pair"\ndriver = "none"', "no driver 'none'; its drivers are 'simulated'"),
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


@pytest.mark.parametrize(("timeout_s", "period_s"), [(2.0, 0.1), (0.25, 0.05)])
def test_it_looks_for_the_server_often_enough(
    make_host: MakeHost, timeout_s: float, period_s: float
) -> None:
    new = f'name = "pair"\nserver_timeout_s = {timeout_s}'
    cell = Cell(make_host, replace={'name = "pair"': new})
    assert [one for one, _ in cell.host.repeated] == [pytest.approx(period_s)]


def test_a_drivers_own_topics_are_heard_while_the_robot_may_move(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    accepts = cell.robot._topics._accepts
    assert not accepts()
    cell.robot.activate()
    assert accepts()
    cell.host.needs_start = "a stop"
    assert not accepts()


# Commands


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
    cell.receive(to_joint_state(JointSample(names=ARM, position=np.array([0.3, 0.1]), stamp_ns=1)))
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
    """The next command is played at once."""
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


def test_a_thread_without_commands_looks_again_soon(cell: Cell) -> None:
    started_s = time.monotonic()
    cell.play()
    assert 0.04 <= time.monotonic() - started_s < SOON_S
    assert cell.told == []


def test_a_command_that_is_played_late_has_that_much_more_time(cell: Cell) -> None:
    """Else the arm would catch up, faster than was asked for."""
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
    assert cell.host.status.latency.median_and_p99() == pytest.approx((300.0, 300.0))


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


@pytest.mark.parametrize("positions", [[float("nan"), 0.0], [0.1], [0.1, 0.2, 0.3]])
def test_a_damaged_command_is_counted_and_leaves_the_one_before(
    cell: Cell, positions: list[float]
) -> None:
    cell.command(0.1)
    message = to_joint_trajectory(
        JointCommand(names=ARM, position=np.array([0.5, 0.0]), duration_s=0.1)
    )
    message.points[0].positions = positions
    cell.receive(message)
    assert cell.host.drops() == {"malformed_command": 1}
    assert cell.host.values()["error"]
    cell.play()
    assert cell.sent == [(0.1, 0.1)]
    assert not cell.host.values().get("error"), "it works again"


def test_a_command_that_the_driver_refuses_is_counted_and_told(cell: Cell) -> None:
    def refuse(command: JointCommand) -> JointCommand:
        raise UnsafeError("beyond the joint's travel")

    cell.driver.send = refuse
    cell.command(0.1)
    cell.play()
    assert cell.host.drops() == {"refused_command": 1}
    assert "beyond the joint's travel" in cell.host.values()["error"]
    assert not cell.robot._moving
    assert cell.host.values().get("note", "") == ""


# Stops


STOPS: dict[str, Callable[[Cell], None]] = {
    "emergency_stop": lambda cell: setattr(cell.host, "stopped", True),
    "server_silent": lambda cell: (
        setattr(cell.host, "silence_s", SERVER_TIMEOUT_S + 0.001),
        cell.watch(),
        cell.told.clear(),
    )[0],
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


@pytest.mark.parametrize("word", ["emergency_stop", "needs_new_start"])
def test_a_stop_while_a_command_is_sent_is_followed_by_a_hold(cell: Cell, word: str) -> None:
    """The hold of the stop itself came before the command."""
    cell.while_sending = lambda: STOPS[word](cell)
    cell.command(0.1, 0.2)
    cell.play()
    assert [type(one).__name__ for one in cell.told] == ["JointCommand", "str"]
    assert not cell.robot._moving
    assert cell.host.values().get("note", "") == ""


def test_an_emergency_stop_holds_at_once_and_drops_what_was_to_come(cell: Cell) -> None:
    cell.command(0.1, 0.2)
    cell.robot.emergency_stop(True)
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
    timer = threading.Timer(0.05, cell.robot.emergency_stop, [True])
    timer.start()
    started_s = time.monotonic()
    cell.play()
    timer.join()
    assert time.monotonic() - started_s < SOON_S
    cell.play()
    assert cell.sent == [(0.1, 60.0)]


def test_what_was_to_come_is_forgotten_after_a_stop(cell: Cell) -> None:
    cell.command(0.1)
    cell.robot.forget()
    cell.play()
    assert cell.told == []


def test_a_silent_server_holds_the_robot_once_and_longer_than_its_silence(cell: Cell) -> None:
    cell.command(0.1)
    cell.host.silence_s = SERVER_TIMEOUT_S
    cell.watch()
    assert cell.told == []
    cell.host.silence_s = SERVER_TIMEOUT_S + 0.001
    cell.watch()
    cell.watch()
    assert cell.told == ["hold"]
    assert cell.host.drops() == {"server_silent": 1}
    assert cell.host.values()["note"] == "holding: no sign of life of the server for 2 s"
    cell.play()
    assert cell.told == ["hold"], "what was to come is dropped"
    cell.host.silence_s = 0.0
    cell.watch()
    cell.command(0.2)
    cell.play()
    assert cell.sent == [(0.2, 0.1)]
    cell.host.silence_s = 9.0
    cell.watch()
    assert cell.holds == 2


def test_an_inactive_robot_is_not_held_for_a_silent_server(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.host.silence_s = 9.0
    cell.watch()
    assert cell.told == []
    assert cell.host.drops() == {}


# When commands cease


def test_the_driver_holds_once_when_commands_cease(cell: Cell) -> None:
    cell.command(0.1, step_s=0.1)
    cell.play()
    cell.clock.go(0.1 + TIMEOUT_S - 1e-6)
    cell.play()
    assert cell.holds == 0, "counted from the end of the last command"
    cell.clock.go(2e-6)
    cell.play()
    cell.play()
    assert cell.holds == 1
    assert cell.host.values()["note"] == "holding: no command"


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


# Activating and deactivating


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


# What it measures


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


# The gripper


GRIPPER = GripperProfile(joint="finger", open_position=0.04, closed_position=0.0)


@pytest.fixture
def gripped(make_host: MakeHost) -> Cell:
    cell = Cell(make_host)
    cell.robot._gripper = GRIPPER
    return cell


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


def test_a_closed_gripper_is_told_at_the_first_command(gripped: Cell) -> None:
    gripped.host.status.changed.clear()
    grip(gripped, 0.0)
    assert gripped.host.status.changed.is_set()
    assert gripped.host.values()["gripper_commanded"] == "0"


def test_a_command_without_the_gripper_tells_no_opening(gripped: Cell) -> None:
    grip(gripped, 0.5, names=(*ARM, "thumb"))
    assert "gripper_commanded" not in gripped.host.values()


def test_a_robot_without_a_gripper_has_no_commanded_opening(cell: Cell) -> None:
    grip(cell, 0.5)
    assert "gripper_commanded" not in cell.host.values()
