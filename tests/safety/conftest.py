"""A simulated FR3 with its modules in separate processes, and a foreign node on the same ROS graph
that observes it.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_plan
from rn_testing.waiting import wait_until
from roboneuron.config import Config, parse_config
from roboneuron.estop.motion_starts import MotionStarts
from roboneuron.ros.environment import prepare_environment
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.tools.arm.plugin import LIMITS

CONFIG = """
[robot]
name = "fr3"
command_timeout_s = 0.5
[perception]
source = "fr3-sim-camera"
cameras = ["front", "wrist"]
[inference]
backend = "servo"
instruction = "pick up the red cube"
max_image_age_s = 0.5
[control]
controller = "urdf"
action_timeout_s = 0.4
[supervisor]
start_timeout_s = 60.0
"""
STILL_RAD_S = 0.02
"""Joint speed below which the arm stands."""


PAIR_CONFIG = """
[robot]
name = "fr3-pair"
command_timeout_s = 0.5
[control]
controller = "urdf"
action_timeout_s = 0.4
[supervisor]
start_timeout_s = 60.0
"""


class Arm:
    """The FR3 of one test module, as observed by a foreign node; times are monotonic."""

    text = CONFIG
    joints: slice | list[int] = slice(7)
    """The arm's joints among the measured ones."""

    def __init__(self, state: Path, more: str = "") -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        from roboneuron.ros.qos import NEWEST

        self.state_directory = state
        self.config: Config = parse_config(self.text + more)
        self.supervisor = Supervisor(state)
        self.supervisor.on_join = (LIMITS.on_join or "",)
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node(
            "stranger", namespace=self.config.namespace, context=self.context
        )
        self.states: list[tuple[float, np.ndarray, np.ndarray]] = []
        self.tcp: list[tuple[float, np.ndarray]] = []
        self.action_times: list[float] = []
        self.command_times: list[float] = []
        self.actions = self.node.create_publisher(Float64MultiArray, "action", NEWEST)
        self.other_actions = self.node.create_publisher(Float64MultiArray, "action", NEWEST)
        self.node.create_subscription(JointState, "joint_states", self._on_state, NEWEST)
        self.node.create_subscription(PoseStamped, "ee_pose", self._on_pose, NEWEST)
        self.node.create_subscription(
            Float64MultiArray,
            "action",
            lambda _: self.action_times.append(time.monotonic()),
            NEWEST,
        )
        self.node.create_subscription(
            JointTrajectory,
            "joint_trajectory",
            lambda _: self.command_times.append(time.monotonic()),
            NEWEST,
        )
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def _on_state(self, message: Any) -> None:
        self.states.append(
            (
                time.monotonic(),
                np.array(message.position)[self.joints],
                np.array(message.velocity)[self.joints],
            )
        )

    def _on_pose(self, message: Any) -> None:
        p = message.pose.position
        self.tcp.append((time.monotonic(), np.array([p.x, p.y, p.z])))

    def start(self, *kinds: Any) -> None:
        """Start the modules that are not running."""
        for kind in kinds:
            if self.supervisor.view(kind).phase != "running":
                self.supervisor.start(fake_plan(kind, self.config))

    def pid(self, kind: Any) -> int:
        process = self.supervisor.view(kind).process
        assert process is not None
        return int(process.pid)

    def dropped(self, kind: Any, word: str) -> int:
        report = self.supervisor.view(kind).report
        return 0 if report is None else report.dropped_by.get(word, 0)

    def metric(self, kind: Any, key: str) -> str:
        report = self.supervisor.view(kind).report
        return "" if report is None else report.metrics.get(key, "")

    def needs_start(self, kind: Any) -> str:
        report = self.supervisor.view(kind).report
        return "" if report is None else report.needs_start

    def permit(self) -> None:
        """Ask for motion, as a client does after a stop."""
        MotionStarts(self.supervisor).permit()

    def note(self, kind: Any) -> str:
        report = self.supervisor.view(kind).report
        return "" if report is None else report.note

    def velocities(self, since_s: float) -> np.ndarray:
        """Measured joint velocities (k, 7) since this time [rad/s]."""
        return np.array([v for at, _, v in list(self.states) if at >= since_s])

    def places(self, since_s: float) -> np.ndarray:
        """Measured TCP positions (k, 3) since this time [m]."""
        return np.array([p for at, p in list(self.tcp) if at >= since_s])

    def is_still(self) -> bool:
        """True if no joint moved during the last ten states, which are recent."""
        last = list(self.states)[-10:]
        return (
            len(last) == 10
            and time.monotonic() - last[0][0] < 0.5
            and max(float(np.abs(v).max()) for _, _, v in last) < STILL_RAD_S
        )

    def is_moving(self) -> bool:
        """True if a joint moves."""
        return bool(self.states) and float(np.abs(self.states[-1][2]).max()) > 5 * STILL_RAD_S

    def act(self, values: list[float]) -> None:
        """Publish one action without checks."""
        from std_msgs.msg import Float64MultiArray

        self.actions.publish(Float64MultiArray(data=values))

    def wave(self, there: bool) -> Any:
        """An action that moves the arm forth or back."""
        from std_msgs.msg import Float64MultiArray

        return Float64MultiArray(data=[0.0, 0.02 if there else -0.02, 0.0, 0.0, 0.0, 0.0, 1.0])

    @contextlib.contextmanager
    def waving(self) -> Iterator[None]:
        """Move the TCP by 20 mm per 0.1 s to and fro within the block."""
        end = threading.Event()

        def wave() -> None:
            turn = 0
            while not end.wait(0.1):
                self.other_actions.publish(self.wave(turn % 12 < 6))
                turn += 1

        thread = threading.Thread(target=wave)
        thread.start()
        try:
            yield
        finally:
            end.set()
            thread.join()

    def close(self) -> None:
        import rclpy

        self.supervisor.close()
        self._stop.set()
        self._thread.join(5.0)
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


class Pair(Arm):
    """Two FR3s at one table; actions move both."""

    text = PAIR_CONFIG
    joints = [*range(7), *range(9, 16)]  # noqa: RUF012

    def is_moving(self) -> bool:
        """True if a joint of each arm moves."""
        if not self.states:
            return False
        left, right = np.split(np.abs(self.states[-1][2]), 2)
        return bool(min(left.max(), right.max()) > 5 * STILL_RAD_S)

    def wave(self, there: bool) -> Any:
        """Joint velocities that move both arms forth or back."""
        from rn_robot_fr3.profile import pair_profile
        from roboneuron.contract import GRIPPER, robot_space
        from roboneuron.ros.messages import to_action_message

        space = robot_space("joint_velocity", pair_profile(), 10.0)
        speed = 0.2 if there else -0.2
        row = [1.0 if channel.name == GRIPPER else speed for channel in space.channels]
        return to_action_message(np.array(row), space)


@pytest.fixture(scope="session")
def wait() -> Callable[[Callable[[], bool], float, str], float]:
    """Bounded wait for a condition."""
    return wait_until


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    """An FR3 on its own ROS domain; tests start the modules they need."""
    yield from _made(Arm, tmp_path_factory)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    """Two FR3s at one table on their own ROS domain."""
    yield from _made(Pair, tmp_path_factory)


@pytest.fixture(scope="module")
def arm_with(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Iterator[Arm]]:
    """Makes an FR3 with more configuration, as `arm` does."""
    return lambda more: _made(Arm, tmp_path_factory, more)


def _made(
    kind: type[Arm], tmp_path_factory: pytest.TempPathFactory, more: str = ""
) -> Iterator[Arm]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
        patch.setenv("ROS_LOG_DIR", os.environ.get("ROS_LOG_DIR", ""))
        state = tmp_path_factory.mktemp("state")
        prepare_environment(state / "log")
        created = kind(state, more)
        try:
            yield created
        finally:
            created.close()
