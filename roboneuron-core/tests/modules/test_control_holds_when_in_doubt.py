"""The control module on a ROS graph, judged by its published commands: stops, a frozen server or
process, the lifecycle. What it makes of its inputs is shown on a test clock
(test_control_doubts_what_it_is_told.py).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from rn_testing.waiting import holds_within
from roboneuron.contract import JointSample
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.gate.audit import AuditLog
from roboneuron.modules.settings import SERVER_SILENT, START_PARAMETER
from roboneuron.ros.messages import to_action_message, to_joint_state
from roboneuron.ros.qos import LATCHED, NEWEST

pytestmark = pytest.mark.ros
FORWARD = np.array([0.01, 0, 0, 0, 0, 0, 1.0])


class Cell:
    """Control, fed with joint states by a timer, and a publisher of actions."""

    def __init__(self, world: Any, **options: Any) -> None:
        self.world = world
        self.position = np.array([0.5, -0.5])
        self.commands = world.listen(JointTrajectory, "joint_trajectory")
        self.control = world.start("control", **options)
        self.states = world.publisher(JointState, "joint_states")
        self.actions = world.publisher(Float64MultiArray, "action")
        self.timer = world.node.create_timer(0.01, self.send_state)
        assert holds_within(lambda: self.value("ready") == "true")
        assert holds_within(self.control.outputs["joint_trajectory"])

    def send_state(self) -> None:
        now_ns = self.world.node.get_clock().now().nanoseconds
        self.states.publish(
            to_joint_state(
                JointSample(names=("a", "b"), position=self.position.copy(), stamp_ns=now_ns)
            )
        )

    def value(self, key: str) -> str:
        message = self.control.status.to_message()
        return next((pair.value for pair in message.values if pair.key == key), "")

    def count(self, word: str) -> int:
        return int(self.value(f"dropped.{word}") or 0)

    def act(self) -> None:
        self.actions.publish(to_action_message(FORWARD))

    def follows(self) -> bool:
        """Whether control follows an action."""
        before = len(self.commands)
        return self._act_until(lambda: any(map(self._is_forward, self.commands[before:])))

    def drops(self, word: str) -> bool:
        """Whether control drops an action for this reason."""
        before = self.count(word)
        return self._act_until(lambda: self.count(word) > before)

    def is_held(self) -> bool:
        """Whether the newest command is a hold where the arm is."""
        return not self._is_forward(self.commands[-1])

    def _is_forward(self, command: JointTrajectory) -> bool:
        return bool(command.points[0].positions[0] > self.position[0] + 1e-3)

    def _act_until(self, is_done: Callable[[], bool]) -> bool:
        """Send an action, or one of a few: on a busy machine one may be late."""
        for _ in range(10):
            self.act()
            if holds_within(is_done, 2.0):
                return True
        return False


@pytest.fixture
def cell(world: Any) -> Cell:
    return Cell(world)


def test_an_action_becomes_a_command_and_actions_that_stop_one_hold(cell: Cell) -> None:
    assert cell.follows()
    assert list(cell.commands[-1].points[0].positions) == pytest.approx([0.51, -0.5])
    assert holds_within(cell.is_held, 2.0)
    assert list(cell.commands[-1].points[0].positions) == pytest.approx([0.5, -0.5])
    assert cell.value("note") == "holding: No action for 0.3 s."
    count = len(cell.commands)
    assert not holds_within(lambda: len(cell.commands) > count, 0.3)


@pytest.mark.parametrize(
    "qos", [LATCHED, NEWEST], ids=["transient local", "volatile, as ros2 topic pub"]
)
def test_any_node_may_stop_and_the_latch_outlives_it(cell: Cell, qos: QoSProfile) -> None:
    publisher = cell.world.node.create_publisher(Bool, "emergency_stop", qos)
    assert holds_within(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(Bool(data=True))
    assert holds_within(lambda: cell.value("emergency_stop") == "true")
    latch = EmergencyStopLatch(cell.world.state_directory / ESTOP_FILE, time.time_ns)
    assert holds_within(lambda: "topic" in latch.read_state().who), (
        "it stops first, and writes then"
    )


def reset(cell: Cell) -> None:
    """Reset the stop as another process does."""
    folder = cell.world.state_directory
    latch = EmergencyStopLatch(folder / ESTOP_FILE, time.time_ns)
    latch.reset(who="test", role="admin", audit=AuditLog(folder / "audit.jsonl", time.time_ns))


def test_emergency_stop_holds_and_refuses_until_it_is_reset(cell: Cell) -> None:
    stop = cell.world.publisher(Bool, "emergency_stop", LATCHED)
    assert cell.follows()
    stop.publish(Bool(data=True))
    assert holds_within(lambda: cell.value("emergency_stop") == "true")
    assert holds_within(cell.is_held)
    count = len(cell.commands)
    assert cell.drops("emergency_stop")
    stop.publish(Bool(data=False))
    (cell.world.state_directory / ESTOP_FILE).unlink()
    assert not holds_within(lambda: cell.value("emergency_stop") == "false", 0.2), (
        "released without the latch, or without a reset"
    )
    reset(cell)
    assert holds_within(lambda: cell.value("emergency_stop") == "false")
    assert cell.drops("needs_new_start"), "a release starts nothing"
    assert len(cell.commands) == count
    assert cell.value("needs_start") == "the emergency stop"
    cell.world.permit(cell.control)
    assert cell.follows()


def test_whoever_asked_for_motion_before_a_stop_starts_none_after_it(cell: Cell) -> None:
    """The request is late: a stop was pressed and released since the server last checked."""
    asked = [Parameter(START_PARAMETER, value=cell.control.stops)]
    cell.world.run(lambda: cell.control.require_start("a reflex"))
    answer = cell.world.run(lambda: cell.control.set_parameters(asked))[0]
    assert not answer.successful
    assert answer.reason.endswith(": a reflex")
    assert cell.drops("needs_new_start")
    assert not cell.commands


def test_latch_file_stops_without_any_message_until_it_is_reset(cell: Cell) -> None:
    assert cell.follows()
    latch = cell.world.state_directory / ESTOP_FILE
    latch.parent.mkdir(parents=True, exist_ok=True)
    latch.touch()
    assert holds_within(lambda: cell.value("emergency_stop") == "true")
    assert holds_within(cell.is_held)
    count = len(cell.commands)
    cell.world.publisher(Bool, "emergency_stop", LATCHED).publish(Bool(data=False))
    assert not holds_within(lambda: cell.value("emergency_stop") == "false", 0.2)
    reset(cell)
    assert holds_within(lambda: cell.value("emergency_stop") == "false")
    assert len(cell.commands) == count


def test_deactivation_holds_and_silences(cell: Cell) -> None:
    assert cell.follows()
    cell.world.run(cell.control.trigger_deactivate)
    assert holds_within(cell.is_held)
    count = len(cell.commands)
    cell.act()
    assert not holds_within(lambda: len(cell.commands) > count, 0.3)


def test_limits_are_tightened_while_it_runs_and_never_widened(cell: Cell) -> None:
    configured = cell.control.settings.config.limits

    def set_limits(text: str) -> Any:
        return cell.world.run(
            lambda: cell.control.set_parameters([Parameter("limits", value=text)])
        )[0]

    slow = configured.model_copy(update={"velocity_fraction": 0.02})
    assert set_limits(slow.model_dump_json()).successful
    assert cell.value("limits") == "tightened"
    for _ in range(20):
        cell.act()
        if holds_within(lambda: cell.value("limited.velocity") != "", 0.1):
            break
    assert cell.value("limited.velocity") != ""
    wide = configured.model_copy(update={"max_speed_m_s": configured.max_speed_m_s * 2})
    refused = set_limits(wide.model_dump_json())
    assert not refused.successful
    assert "can only be tightened" in refused.reason
    assert not set_limits('{"max_speed_m_s": "slow"}').successful
    assert set_limits("").successful
    assert cell.value("limits") == "configured"


def test_server_that_is_frozen_stops_the_arm_until_it_asks_for_motion_again(world: Any) -> None:
    """Without a server there are no heartbeats, and no requests."""
    # long enough for a few actions on a busy machine
    new = "action_timeout_s = 0.3\nserver_timeout_s = 1.0"
    cell = Cell(world, replace={"action_timeout_s = 0.3": new})
    policy = cell.world.node.create_timer(0.03, cell.act)
    assert holds_within(lambda: len(cell.commands) > 20)
    for _ in range(2):
        cell.control.note_beat()
        if cell.control.needs_start:
            count = len(cell.commands)
            assert not holds_within(lambda count=count: len(cell.commands) > count, 0.2), (
                "its life starts nothing"
            )
            cell.control.note_beat()
            cell.world.permit(cell.control)
        before, dropped = len(cell.commands), cell.count("server_silent")

        def moves(before: int = before) -> bool:
            cell.control.note_beat()
            return len(cell.commands) > before + 3

        assert holds_within(moves)
        assert holds_within(lambda dropped=dropped: cell.count("server_silent") > dropped + 5)
        assert cell.value("hold_code") == "server_silent"
        count = len(cell.commands)
        assert not holds_within(lambda count=count: len(cell.commands) > count, 0.2)
    cell.world.run(policy.cancel)


@pytest.mark.parametrize("kind", ["robot", "inference", "control"])
def test_a_module_whose_process_was_frozen_needs_a_new_start(
    world: Any, status_of: Any, kind: str
) -> None:
    node = world.start(kind)
    for stops in (1, 2):
        node.note_resumed()
        assert node.is_server_silent(), "at once, though the executor has not run since"
        assert holds_within(lambda stops=stops: node.stops == stops)
        assert not node.is_server_silent()
        assert status_of(node)["needs_start"] == f"the {kind} process was frozen"


def test_a_control_that_was_frozen_needs_a_new_start_though_the_server_is_heard_first(
    world: Any,
) -> None:
    """The thread that reads the heartbeats resumes before the executor does."""
    cell = Cell(
        world,
        replace={"action_timeout_s = 0.3": "action_timeout_s = 0.3\nserver_timeout_s = 0.4"},
    )
    beats = cell.world.node.create_timer(0.03, cell.control.note_beat)
    policy = cell.world.node.create_timer(0.03, cell.act)
    assert holds_within(lambda: len(cell.commands) > 5)

    def freeze() -> None:
        time.sleep(0.8)
        cell.control.note_beat()

    cell.world.run(freeze)
    assert holds_within(lambda: cell.control.needs_start == SERVER_SILENT), "it goes on by itself"
    count = len(cell.commands)
    assert not holds_within(lambda: len(cell.commands) > count + 1, 0.4), (
        "one command may have been on its way"
    )
    cell.world.permit(cell.control)
    assert holds_within(lambda: len(cell.commands) > count + 5)
    beats.cancel()
    cell.world.run(policy.cancel)


def test_a_silence_while_a_module_was_loading_is_no_stop(world: Any) -> None:
    """Imports may block every thread of a process; nothing moved meanwhile."""
    # long enough for a busy machine between two signs of life
    control = world.module("control", replace={"action_timeout_s = 0.3": "server_timeout_s = 2.0"})
    control.note_beat()
    kind = control._kind

    def load(node: Any) -> Any:
        time.sleep(2.2)
        control.note_beat()
        return kind(node)

    control._kind = load
    world.run(control.trigger_configure)
    assert not control.needs_start
    world.run(lambda: None)
    assert not control.needs_start
