"""The control module, judged by its published commands."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
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
from roboneuron.ros.messages import to_action_message, to_joint_state
from roboneuron.ros.qos import LATCHED, NEWEST

pytestmark = pytest.mark.ros
FORWARD = np.array([0.01, 0, 0, 0, 0, 0, 1.0])


class Cell:
    """Control, fed with joint states by a timer, and a publisher of actions."""

    def __init__(self, world: Any, **options: Any) -> None:
        self.world = world
        self.position = np.array([0.5, -0.5])
        self.names: tuple[str, ...] = ("a", "b")
        self.commands = world.listen(JointTrajectory, "joint_trajectory")
        self.control = world.start("control", **options)
        self.states = world.publisher(JointState, "joint_states")
        self.actions = world.publisher(Float64MultiArray, "action")
        self.timer = world.node.create_timer(0.01, self.send_state)
        assert holds_within(lambda: self.value("ready") == "true")
        topic = (
            "joint_command"
            if self.control.settings.config.control.command == "joint_state"
            else "joint_trajectory"
        )
        assert holds_within(self.control.outputs[topic])

    def send_state(self) -> None:
        now_ns = self.world.node.get_clock().now().nanoseconds
        self.states.publish(
            to_joint_state(
                JointSample(names=self.names, position=self.position.copy(), stamp_ns=now_ns)
            )
        )

    def value(self, key: str) -> str:
        message = self.control.status.to_message()
        return next((pair.value for pair in message.values if pair.key == key), "")

    def dropped(self, word: str) -> int:
        return int(self.value(f"dropped.{word}") or 0)

    def last(self) -> list[float]:
        return list(self.commands[-1].points[0].positions)


@pytest.fixture
def cell(world: Any) -> Cell:
    return Cell(world)


def test_action_becomes_a_command_from_the_measured_joints(cell: Cell) -> None:
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    assert cell.last() == pytest.approx([0.51, -0.5])


def test_actions_that_stop_are_followed_by_one_hold_at_the_measured_joints(cell: Cell) -> None:
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    cell.position = np.array([0.505, -0.5])
    assert holds_within(lambda: len(cell.commands) == 2, 2.0)
    assert cell.last() == pytest.approx([0.505, -0.5])
    assert cell.value("note") == "holding: No action for 0.3 s."
    assert not holds_within(lambda: len(cell.commands) > 2, 0.5)


def test_joint_states_that_stop_forbid_acting(cell: Cell) -> None:
    cell.world.run(cell.timer.cancel)
    assert holds_within(lambda: cell.control.module.why_not(0.0, 0) == "stale_joint_state")
    for _ in range(10):  # one that comes over 0.3 s late, on a busy machine, is stale itself
        cell.actions.publish(to_action_message(FORWARD))
        if holds_within(lambda: cell.dropped("stale_joint_state") > 0, 2.0):
            break
    assert cell.dropped("stale_joint_state") > 0
    assert not cell.commands


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ([np.nan, 0, 0, 0, 0, 0, 1], "non_finite"),
        ([0, np.inf, 0, 0, 0, 0, 1], "non_finite"),
        ([0.01] * 6, "malformed"),
        ([0.01] * 8, "malformed"),
        ([], "malformed"),
        ([0.01, 0, 0, 0, 0, 0, 1.5], "malformed"),
        ([0.2, 0, 0, 0, 0, 0, 1], "too_far"),
        ([1e308, 0, 0, 0, 0, 0, 1], "too_far"),
    ],
)
def test_bad_action_is_counted_and_moves_nothing(
    cell: Cell, values: list[float], word: str
) -> None:
    cell.actions.publish(Float64MultiArray(data=values))
    assert holds_within(lambda: cell.dropped(word) == 1)
    assert not cell.commands


def test_refused_action_ends_a_motion_at_once(cell: Cell) -> None:
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    cell.actions.publish(Float64MultiArray(data=[0.2, 0, 0, 0, 0, 0, 1.0]))
    assert holds_within(lambda: len(cell.commands) == 2, 0.2)
    assert cell.last() == pytest.approx([0.5, -0.5])


def test_late_action_is_dropped(cell: Cell) -> None:
    module = cell.control.module
    assert module.why_not(0.29, 1) is None
    assert module.why_not(0.31, 1) == "stale_action"


def test_reordered_action_is_dropped(cell: Cell) -> None:
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    assert cell.control.module.why_not(0.0, 1) == "reordered_action"


@pytest.mark.parametrize(
    "damage",
    [
        lambda cell: setattr(cell, "position", np.array([np.nan, 0.0])),
        lambda cell: setattr(cell, "names", ("a", "a")),
        lambda cell: setattr(cell, "position", np.array([0.1])),
    ],
)
def test_damaged_joint_states_count_as_none(cell: Cell, damage: Callable[[Cell], None]) -> None:
    damage(cell)
    assert holds_within(lambda: cell.control.module.why_not(0.0, 0) == "stale_joint_state")
    assert cell.value("error_code") in ("unsafe", "invalid_input")
    for _ in range(10):  # one that comes over 0.3 s late, on a busy machine, is stale itself
        cell.actions.publish(to_action_message(FORWARD))
        if holds_within(lambda: cell.dropped("stale_joint_state") > 0, 2.0):
            break
    assert cell.dropped("stale_joint_state") > 0
    assert not cell.commands


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
    stop = cell.world.node.create_publisher(Bool, "emergency_stop", LATCHED)
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    stop.publish(Bool(data=True))
    assert holds_within(lambda: cell.value("emergency_stop") == "true")
    assert holds_within(lambda: len(cell.commands) == 2)
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: cell.dropped("emergency_stop") == 1)
    assert len(cell.commands) == 2
    stop.publish(Bool(data=False))
    assert not holds_within(lambda: cell.value("emergency_stop") == "false", 0.2), (
        "released without the latch"
    )
    (cell.world.state_directory / ESTOP_FILE).unlink()
    assert not holds_within(lambda: cell.value("emergency_stop") == "false", 0.2), (
        "released without a reset"
    )
    reset(cell)
    assert holds_within(lambda: cell.value("emergency_stop") == "false")
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: cell.dropped("needs_new_start") == 1), "a release starts nothing"
    assert len(cell.commands) == 2
    assert cell.value("needs_start") == "the emergency stop"
    cell.world.permit(cell.control)
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 3)


def test_whoever_asked_for_motion_before_a_stop_starts_none_after_it(cell: Cell) -> None:
    """The request is late: a stop was pressed and released since the server last checked."""
    from rclpy.parameter import Parameter

    from roboneuron.modules.settings import START_PARAMETER

    asked = [Parameter(START_PARAMETER, value=cell.control.stops)]
    cell.world.run(lambda: cell.control.require_start("a reflex"))
    answer = cell.world.run(lambda: cell.control.set_parameters(asked))[0]
    assert not answer.successful
    assert "a stop came since" in answer.reason
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: cell.dropped("needs_new_start") == 1)
    assert not cell.commands


def test_latch_file_stops_without_any_message_until_it_is_reset(cell: Cell) -> None:
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    latch = cell.world.state_directory / ESTOP_FILE
    latch.parent.mkdir(parents=True, exist_ok=True)
    latch.touch()
    assert holds_within(lambda: len(cell.commands) == 2)
    cell.world.node.create_publisher(Bool, "emergency_stop", LATCHED).publish(Bool(data=False))
    assert not holds_within(lambda: cell.value("emergency_stop") == "false", 0.2)
    reset(cell)
    assert holds_within(lambda: cell.value("emergency_stop") == "false")
    assert len(cell.commands) == 2


def test_deactivation_holds_and_silences(cell: Cell) -> None:
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    cell.world.run(cell.control.trigger_deactivate)
    assert holds_within(lambda: len(cell.commands) == 2)
    cell.actions.publish(to_action_message(FORWARD))
    assert not holds_within(lambda: len(cell.commands) > 2, 0.3)


def test_commands_can_be_joint_states(world: Any) -> None:
    received = world.listen(JointState, "joint_command")
    cell = Cell(world, extra='command = "joint_state"\n')
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(received) >= 1)  # a hold follows
    assert list(received[0].position) == pytest.approx([0.51, -0.5])


def test_a_command_that_would_outlive_a_frozen_control_is_not_sent(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During a command only control could end the motion."""
    controller = cell.control.module.controller
    compute = controller.compute
    monkeypatch.setattr(controller, "compute", lambda *a: replace(compute(*a), duration_s=2.5))
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: cell.dropped("long_command") == 1)
    assert cell.value("hold_code") == "long_command"
    assert not cell.commands


def test_a_command_that_was_ready_too_late_is_not_sent(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller = cell.control.module.controller
    compute = controller.compute

    def linger(*arguments: Any) -> Any:
        time.sleep(0.4)  # like a frozen process, or a slow controller; 0.3 s are allowed
        return compute(*arguments)

    monkeypatch.setattr(controller, "compute", linger)
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: cell.dropped("stale_action") == 1, 2.0)
    assert cell.value("note").startswith("holding: A command was ready only 0.4")
    assert not cell.commands
    monkeypatch.undo()
    # joint states were delayed too, and are stale until the next one arrives
    assert holds_within(lambda: cell.control.module.why_not(0.0, time.time_ns()) is None)
    cell.actions.publish(to_action_message(FORWARD))
    assert holds_within(lambda: len(cell.commands) == 1)
    assert cell.last() == pytest.approx([0.51, -0.5])


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
        cell.actions.publish(to_action_message(FORWARD))
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
