"""A server with its page, a simulated FR3 and the servo policy, for tests of leading."""

from __future__ import annotations

import re
import threading
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal

from rn_standard.console.client import spawned_server
from rn_standard.teleoperation.rows import Acting
from rn_testing.waiting import wait_until
from roboneuron.ros.environment import prepare_environment

INSTRUCTION = "pick up the red cube"
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[view]
enabled = true
port = 0
"""
STILL = [0.0] * 6


class Cell:
    """A server with its page, and a node that observes the robot."""

    def __init__(
        self, environment: dict[str, str], tmp_path: Path, stack: ExitStack, more: str = ""
    ) -> None:
        (tmp_path / "roboneuron.toml").write_text(CONFIG + more)
        log = tmp_path / "server.log"
        self._portal = stack.enter_context(start_blocking_portal())
        with pytest.MonkeyPatch.context() as patch:
            for name, value in environment.items():
                patch.setenv(name, value)
            server = spawned_server(["--config", str(tmp_path / "roboneuron.toml")], log)
            self._client = stack.enter_context(self._portal.wrap_async_context_manager(server))
        pattern = r"live view is at (http://[\d.]+:\d+)"
        wait_until(lambda: bool(re.search(pattern, log.read_text())), 60.0, poll_s=0.1)
        self.url = re.findall(pattern, log.read_text())[0]
        self.poses: list[tuple[float, np.ndarray]] = []
        self.joints: list[tuple[float, np.ndarray]] = []
        self.acting: list[Acting] = []
        self._watch(environment, tmp_path, stack)

    def call(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Call a tool as the agent; a failure is an AssertionError with its text."""
        answer = self._portal.call(self._client.call_tool, tool, arguments)
        assert not answer.is_error, answer.content
        return dict(answer.structured_content or {})

    def refusal(self, tool: str, **arguments: Any) -> str:
        """Text of a tool's refusal."""
        answer = self._portal.call(self._client.call_tool, tool, arguments)
        assert answer.is_error
        return str(answer.content)

    def module(self, kind: str) -> dict[str, Any]:
        """Status of a module."""
        found = [
            one for one in self.call("get_status", details=True)["modules"] if one["module"] == kind
        ]
        return dict(found[0])

    def speed_m_s(self, since_s: float) -> float:
        """Maximum speed of the TCP since a monotonic time."""
        seen = [pose for pose in list(self.poses) if pose[0] >= since_s]
        steps = pairwise(seen)
        return max(float(np.linalg.norm(b[1] - a[1])) / (b[0] - a[0]) for a, b in steps)

    def _watch(self, environment: dict[str, str], tmp_path: Path, stack: ExitStack) -> None:
        prepare_environment(tmp_path / "log")
        import rclpy
        from geometry_msgs.msg import PoseStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray

        context = rclpy.Context()
        context.init(domain_id=int(environment["ROS_DOMAIN_ID"]))
        node = rclpy.create_node("onlooker", context=context)

        def pose(message: PoseStamped) -> None:
            place = message.pose.position
            self.poses.append((time.monotonic(), np.array([place.x, place.y, place.z])))

        def joints(message: JointState) -> None:
            stamp = message.header.stamp
            at_s = stamp.sec + stamp.nanosec / 1e9
            if not self.joints or at_s > self.joints[-1][0]:
                self.joints.append((at_s, np.array(message.position[:7])))

        def acting(message: Float64MultiArray) -> None:
            self.acting.append(Acting.from_message(message))

        for kind, topic, take in (
            (PoseStamped, "ee_pose", pose),
            (JointState, "joint_states", joints),
            (Float64MultiArray, "acting", acting),
        ):
            node.create_subscription(kind, f"/fr3/{topic}", take, qos_profile_sensor_data)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        stack.callback(context.shutdown)
        stack.callback(thread.join, 5.0)
        stack.callback(executor.shutdown)
