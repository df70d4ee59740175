"""Joint commands of the server name it as their sender, which gives it the arm; others stay as
they are.
"""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.direct_path.writer import TopicWriter
from roboneuron.ros.graph import server_node


@pytest.mark.parametrize("way", ["send", "publish", "publish_if_possible"])
@pytest.mark.parametrize(
    ("kind", "topic", "is_signed"),
    [
        (JointTrajectory, "/arm/joint_trajectory", True),
        (JointState, "/arm/joint_command", True),
        (JointState, "/arm/joint_states", False),
        (JointTrajectory, "/controller/joint_trajectories", False),
        (Float64MultiArray, "/controller/joint_command", False),
    ],
)
def test_what_moves_joints_is_signed(way: str, kind: Any, topic: str, is_signed: bool) -> None:
    sent: list[Any] = []
    link: Any = SimpleNamespace(send_if_possible=lambda publisher, message: sent.append(message))
    package = kind.__module__.partition(".")[0]
    writer = TopicWriter(link, kind, f"{package}/msg/{kind.__name__}", topic)
    writer._publisher = SimpleNamespace(publish=sent.append)  # type: ignore[assignment]
    message = kind()
    has_header = hasattr(message, "header")
    if has_header:
        message.header.frame_id = "base"
    getattr(writer, way)(message, *([False] if way == "send" else []))
    assert sent == [message]
    if has_header:
        assert message.header.frame_id == (server_node(os.getpid()) if is_signed else "base")
