"""Measurements of the control box are published on topics and in get_status at a bounded rate,
faults at once.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.fci import state_topics
from rn_robot_fr3.fci.arm import FciState
from rn_robot_fr3.fci.faults import USER_STOP
from rn_robot_fr3.fci.state_topics import StateTopics, described
from rn_testing.fakes import MemoryTopics

MEASURED_NS = 1_700_000_000_250_000_000
STATE = FciState(
    received_s=100.0,
    position=np.arange(7.0),
    velocity=np.arange(7.0) / 10,
    torque=np.arange(7.0) + 20,
    external_torque=np.arange(7.0) - 3,
    wrench=np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
    tcp_m=np.array([0.3, 0.0, 0.5]),
    tcp_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
    mode="Idle",
    success_rate=0.97,
)


class Clock:
    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(state_topics, "time", made)
    return made


def newest(topics: MemoryTopics, topic: str) -> Any:
    return topics.published(topic)[-1]


def test_every_state_is_on_a_topic(clock: Clock) -> None:
    topics = MemoryTopics()
    StateTopics(topics).publish(STATE, None, MEASURED_NS)
    joints = newest(topics, "measured_joint_states")
    stamp = joints.header.stamp
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert joints.name[0] == "fr3_joint1"
    assert (list(joints.position), list(joints.effort)) == (
        STATE.position.tolist(),
        STATE.torque.tolist(),
    )
    assert list(newest(topics, "external_joint_torques").effort) == STATE.external_torque.tolist()
    wrench = newest(topics, "external_wrench_in_base_frame").wrench
    assert (wrench.force.z, wrench.torque.x) == (3.0, 0.1)
    pose = newest(topics, "current_pose").pose
    assert (pose.position.z, pose.orientation.x) == (0.5, 1.0)
    told = {value.key: value.value for value in newest(topics, "robot_state").values}
    assert told == {"mode": "Idle", "fault": "", "errors": "", "control_success_rate": "0.97"}


def test_states_are_told_at_sixty_hertz_and_a_fault_at_once(clock: Clock) -> None:
    topics = MemoryTopics()
    told = StateTopics(topics)
    for _ in range(125):
        told.publish(STATE, None, MEASURED_NS)
        clock.now_s += 0.008
    assert 40 <= len(topics.published("measured_joint_states")) <= 63
    count = len(topics.published("robot_state"))
    assert count <= 11
    told.publish(replace(STATE, mode="UserStopped"), USER_STOP, MEASURED_NS)
    assert len(topics.published("robot_state")) == count + 1
    newest_state = newest(topics, "robot_state")
    assert newest_state.level == newest_state.ERROR
    assert "user stop" in newest_state.message


def test_get_status_has_them_too() -> None:
    detail = described(replace(STATE, errors=("joint_reflex",)), USER_STOP)
    assert json.loads(detail["torque_nm"]) == STATE.torque.tolist()
    assert json.loads(detail["velocity_rad_s"]) == pytest.approx(STATE.velocity.tolist())
    assert json.loads(detail["external_wrench"]) == [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    assert detail["errors"] == "joint_reflex"
    assert detail["fault"].startswith("user_stop")
