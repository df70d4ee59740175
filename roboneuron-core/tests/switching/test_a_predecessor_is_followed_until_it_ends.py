"""A module in shadow counts what its predecessor sends, and goes on from there."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import EE_DELTA, Channel, ControlSpace, JointCommand, Pose
from roboneuron.modules.status import StatusWriter
from roboneuron.ros import topics
from roboneuron.ros.messages import (
    commands_from_message,
    to_action_message,
    to_joint_trajectory,
    to_pose_stamped,
)
from roboneuron.switching import predecessor
from roboneuron.switching.handover import TimedHandover
from roboneuron.switching.predecessor import _on_action, _on_command, _on_pose


@pytest.fixture
def handover() -> TimedHandover:
    return TimedHandover(True, StatusWriter("fake/inference"))


def module(status: StatusWriter, followed: list[Any]) -> Any:
    def follow(message: Any, sent_s: float) -> JointCommand:
        (command,) = commands_from_message(message)
        followed.append((command, sent_s))
        return command

    def note_sent(vector: Any, now_s: float, now_ns: int) -> None:
        followed.append(None if vector is None else vector.tolist())

    return SimpleNamespace(
        status=status,
        executor=SimpleNamespace(note_sent=note_sent),
        space=EE_DELTA,
        node=SimpleNamespace(now_ns=time.time_ns),
        follow=follow,
    )


def test_actions_of_the_predecessor_count_until_the_first_of_ones_own(
    handover: TimedHandover,
) -> None:
    followed: list[Any] = []
    fake = module(handover.status, followed)
    _on_action(fake, handover, Float64MultiArray(data=[1.0]))
    assert not followed, "no action"
    _on_action(fake, handover, to_action_message(np.arange(7.0)))
    handover.note_sent("action")
    _on_action(fake, handover, to_action_message(np.zeros(7)))
    assert followed == [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]


def test_a_row_of_another_space_counts_without_its_numbers(handover: TimedHandover) -> None:
    followed: list[Any] = []
    joints = (Channel(name="a", unit="rad"), Channel(name="b", unit="rad"))
    space = ControlSpace(kind="joint_position", channels=joints)
    _on_action(module(handover.status, followed), handover, to_action_message(np.zeros(2), space))
    assert followed == [None]


def test_a_command_is_followed_from_the_time_it_was_sent(handover: TimedHandover) -> None:
    followed: list[Any] = []
    command = JointCommand(names=("a",), position=np.array([0.5]), duration_s=0.1)
    info = {"source_timestamp": time.time_ns() - 10**9}
    _on_command(module(handover.status, followed), handover, to_joint_trajectory(command), info)
    ((got, sent_s),) = followed
    assert got.names == ("a",)
    assert sent_s <= time.monotonic() - 1.0


def test_a_damaged_command_is_counted_and_not_followed(handover: TimedHandover) -> None:
    followed: list[Any] = []
    _on_command(
        module(handover.status, followed), handover, JointTrajectory(), {"source_timestamp": 0}
    )
    assert not followed
    assert handover.status.report().dropped_by == {"malformed_command": 1}


def test_its_poses_are_read_as_control_writes_them(
    handover: TimedHandover, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[Any] = []
    monkeypatch.setattr(handover, "hear", lambda output, sent_s: heard.append(output))
    pose = Pose(
        position_m=np.array([0.1, 0.2, 0.3]),
        quaternion_xyzw=np.array([0.0, 0.6, 0.0, 0.8]),
        stamp_ns=5 * 10**9 + 7,
    )
    status = StatusWriter("fake/control")
    for x_m in (math.nan, 0.1):
        pose = replace(pose, position_m=np.array([x_m, 0.2, 0.3]))
        _on_pose(module(status, []), handover, to_pose_stamped(pose, "base"))
    assert status.report().dropped_by == {"malformed_pose": 1}
    assert len(heard) == 1
    assert heard[0].stamp_ns == pose.stamp_ns
    assert heard[0].position_m.tolist() == pose.position_m.tolist()
    assert heard[0].quaternion_xyzw.tolist() == pose.quaternion_xyzw.tolist()


@pytest.mark.parametrize("name", ["ACTION", "EE_POSE", "JOINT_COMMAND", "JOINT_TRAJECTORY"])
def test_topics_are_those_of_the_contract(name: str) -> None:
    assert getattr(predecessor, name) == getattr(topics, name)
