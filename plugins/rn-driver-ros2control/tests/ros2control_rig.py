"""The robot module of RoboNeuron with this driver inside, and the stand-in controller: two
processes on one graph, and a node of the test.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD

_SETTINGS = {
    "kind": "robot",
    "node_name": "robot",
}


class ModuleRig:
    """A node of the test beside the module.

    Attributes:
        module: process of the robot module.
        measured: [monotonic s, position of the last joint from its start] as the module tells it.
    """

    def __init__(self, folder: Path, options: dict[str, Any]) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from rclpy.signals import SignalHandlerOptions
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Bool
        from trajectory_msgs.msg import JointTrajectory

        self._log = folder / "robot.log"
        self._config = {
            "robot": {
                "name": "fr3",
                "driver": "ros2-control",
                "command_timeout_s": 5.0,
                "server_timeout_s": 60.0,
            },
            "plugins": {"fr3": {"connect_timeout_s": 60.0, "state_timeout_s": 3.0, **options}},
        }
        self._state = str(folder / "state")
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("mover", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.measured: list[tuple[float, float]] = []
        self._node.create_subscription(JointState, "/joint_states", self._on_joints, 10)
        self._told: dict[str, float] = {}
        self._node.create_subscription(JointState, "/fr3/joint_states", self._on_told, 1)
        self._commands = self._node.create_publisher(JointTrajectory, "/fr3/joint_trajectory", 1)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._stops = self._node.create_publisher(Bool, "/fr3/emergency_stop", latched)
        self._processes: list[subprocess.Popen[bytes]] = []

    def _on_joints(self, message: Any) -> None:
        place = message.position[list(message.name).index(ARM_JOINTS[6])] - HOME_RAD[6]
        self.measured.append((time.monotonic(), float(place)))

    def _on_told(self, message: Any) -> None:
        self._told.update(zip(message.name, message.position, strict=True))

    def start(self) -> None:
        """Start both processes; the module is active in the end."""
        from lifecycle_msgs.srv import ChangeState

        controller = [
            sys.executable,
            "-m",
            "rn_driver_ros2control.standin_node",
            "--joints",
            *ARM_JOINTS,
            "--start",
            *(str(value) for value in HOME_RAD),
        ]
        with self._log.open("wb") as log:
            self._processes.append(subprocess.Popen(controller, stdout=log, stderr=log))
            self.module = subprocess.Popen(
                [sys.executable, "-m", "roboneuron.modules"],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
            )
        settings = {**_SETTINGS, "config": self._config, "state_directory": self._state}
        assert self.module.stdin is not None
        self.module.stdin.write(json.dumps(settings).encode() + b"\n")
        self.module.stdin.flush()
        client = self._node.create_client(ChangeState, "/fr3/robot/change_state")
        self.wait_for(client.service_is_ready, "the module to offer its lifecycle")
        for transition in (1, 3):  # configure, activate
            request = ChangeState.Request()
            request.transition.id = transition
            future = client.call_async(request)
            self.wait_for(future.done, f"transition {transition}")
            assert future.result().success, self._log.read_text()
        self.wait_for(
            lambda: (
                self.reaches(0.0)
                and bool(self.measured)
                and self._commands.get_subscription_count() > 0
                and self._stops.get_subscription_count() > 0
            ),
            "joint states of the module and of the controller",
        )

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < deadline_s, f"{what}: {self._log.read_text()[-2000:]}"
            self._executor.spin_once(timeout_sec=0.02)

    def reaches(self, step: float) -> bool:
        """The module tells that the last joint is so far from its start."""
        place = self._told.get(ARM_JOINTS[6], np.inf) - HOME_RAD[6]
        return bool(abs(place - step) < 1e-3)

    def send(self, steps: Sequence[float], step_s: float) -> None:
        """A trajectory to the module: the last joint goes so far from its start, point by point."""
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        message = JointTrajectory(joint_names=list(ARM_JOINTS))
        for number, step in enumerate(steps, 1):
            nanoseconds = round(number * step_s * 1e9)
            message.points.append(
                JointTrajectoryPoint(
                    positions=[*HOME_RAD[:6], HOME_RAD[6] + step],
                    time_from_start=Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9),
                )
            )
        self._commands.publish(message)

    def stop(self) -> None:
        """Latch the emergency stop on its topic."""
        from std_msgs.msg import Bool

        self._stops.publish(Bool(data=True))

    def rest_s(self, after_s: float) -> float:
        """How long after a monotonic time the controller's joint has moved, once it rests."""
        quiet_s = 0.5
        self.wait_for(lambda: time.monotonic() > after_s + quiet_s and self._is_quiet(quiet_s), "")
        last = self.measured[-1][1]
        moved = [at_s for at_s, place in self.measured if abs(place - last) > 1e-4]
        return max(0.0, max(moved, default=0.0) - after_s)

    def _is_quiet(self, for_s: float) -> bool:
        since_s = time.monotonic() - for_s
        places = [place for at_s, place in self.measured if at_s > since_s]
        return len(places) > 10 and max(places) - min(places) < 1e-5

    def close(self) -> None:
        import rclpy

        if self.module.stdin is not None:
            self.module.stdin.close()  # the module leaves with its parent
        self.module.wait(timeout=30)
        for process in self._processes:
            process.terminate()
            process.wait(timeout=30)
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


@contextmanager
def module_rig(folder: Path, **options: Any) -> Iterator[ModuleRig]:
    """A running rig, with these options of the driver."""
    from roboneuron.ros.environment import prepare_environment

    prepare_environment(folder)
    made = ModuleRig(folder, options)
    try:
        made.start()
        yield made
    finally:
        made.close()
