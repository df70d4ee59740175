"""Comparison of a controller in shadow with its predecessor: both answer the same actions and joint states.

The predecessor's commands are also the reference from which the successor continues, so that the commanded velocity of
the arm does not jump at the handover.
"""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import Hold, JointCommand, JointSample, Pose
from roboneuron.errors import RoboNeuronError
from roboneuron.gate.motion.task_space import angle_rad, distance_m
from roboneuron.modules.status import ModuleStatus
from roboneuron.ros.messages import commands_from_trajectory, joints_from_message, pose_from_message
from roboneuron.ros.qos import NEWEST
from roboneuron.ros.topics import EE_POSE, JOINT_COMMAND, JOINT_TRAJECTORY

_SAMPLES = 64
"""Joint states remembered until the predecessor's pose for one of them arrives: half a second of them."""
_PAIR_S = 0.08
"""The two answers to one action come within this time; actions are farther apart."""
_RECENT = 5
_STATE_STEP_S = 0.1
"""Time given to a JointState command, which carries none."""


class ShadowController:
    """Subscribes beside the running control; everything happens on the executor's thread.

    The status tells `shadow_tcp_difference` (of the two TCP poses for one joint state [m or rad]), `shadow_count`
    (answers to actions), `shadow_difference` (median of the largest difference of a joint between the two answers to
    an action [rad or m]) and `shadow_hold`, why the newest answer is to hold.

    Args:
        forward: TCP pose of a joint state, by the controller in shadow.
        on_command: called with each command of the predecessor and the time at which it was sent [monotonic s].
    """

    def __init__(
        self,
        node: Node,
        status: ModuleStatus,
        command: str,
        forward: Callable[[JointSample], Pose],
        on_command: Callable[[JointCommand, float], None],
    ) -> None:
        self._node = node
        self._status = status
        self._forward = forward
        self._on_command = on_command
        self._samples: deque[JointSample] = deque(maxlen=_SAMPLES)
        self._own: tuple[float, Mapping[str, float]] | None = None
        self._other: tuple[float, Mapping[str, float]] | None = None
        self._differences: deque[float] = deque(maxlen=_RECENT)
        self._count = 0
        trajectory = command == "joint_trajectory"
        self._subscriptions = [
            node.create_subscription(PoseStamped, EE_POSE, self._on_pose, NEWEST),
            node.create_subscription(JointTrajectory, JOINT_TRAJECTORY, self._on_trajectory, NEWEST)
            if trajectory
            else node.create_subscription(JointState, JOINT_COMMAND, self._on_state, NEWEST),
        ]

    def close(self) -> None:
        """Stop listening; idempotent."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def see(self, joints: JointSample) -> None:
        """A joint state that the predecessor may tell a pose for."""
        self._samples.append(joints)

    def answer(self, outcome: JointCommand | Hold) -> None:
        """What this controller would send for an action now."""
        self._count += 1
        self._status.set_value("shadow_count", self._count)
        if isinstance(outcome, Hold):
            self._status.set_value("shadow_hold", f"{outcome.code}: {outcome.reason}")
            self._own = None
            return
        self._status.set_value("shadow_hold", "")
        self._own = (time.monotonic(), dict(zip(outcome.names, outcome.position.tolist(), strict=True)))
        self._compare()

    def _compare(self) -> None:
        """Two answers are to one action when they come at about one time, in whatever order."""
        if self._own is None or self._other is None or abs(self._own[0] - self._other[0]) > _PAIR_S:
            return
        mine, other = self._own[1], self._other[1]
        self._own = self._other = None
        shared = mine.keys() & other.keys()
        if shared:
            self._differences.append(max(abs(mine[name] - other[name]) for name in shared))
            self._status.set_value("shadow_difference", statistics.median(self._differences))
            self._status.set_value("shadow_compared", len(self._differences))

    def _on_pose(self, message: PoseStamped) -> None:
        pose = pose_from_message(message)
        for joints in self._samples:
            if joints.stamp_ns == pose.stamp_ns:
                mine = self._forward(joints)
                difference = max(distance_m(mine, pose), angle_rad(mine, pose))
                self._status.set_value("shadow_tcp_difference", float(np.round(difference, 9)))
                return

    def _on_trajectory(self, message: JointTrajectory, info: dict[str, Any]) -> None:
        self._take(lambda: commands_from_trajectory(message)[0], info)

    def _on_state(self, message: JointState, info: dict[str, Any]) -> None:
        def read() -> JointCommand:
            joints = joints_from_message(message)
            return JointCommand(names=joints.names, position=joints.position, duration_s=_STATE_STEP_S)

        self._take(read, info)

    def _take(self, read: Callable[[], JointCommand], info: dict[str, Any]) -> None:
        try:
            command = read()
        except RoboNeuronError:
            self._status.dropped.add("malformed_command")
            return
        age_s = max(0.0, (time.time_ns() - int(info["source_timestamp"])) / 1e9)
        sent_s = time.monotonic() - age_s
        self._on_command(command, sent_s)
        self._other = (sent_s, dict(zip(command.names, command.position.tolist(), strict=True)))
        self._compare()
