"""The robot module of RoboNeuron, the driver inside it and the stand-in controller: two processes
on one graph.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.domain import free_ros_domain

pytestmark = pytest.mark.ros


def test_a_trajectory_to_the_robot_module_moves_the_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    from roboneuron.ros.environment import prepare_environment

    prepare_environment(tmp_path)
    import rclpy
    from builtin_interfaces.msg import Duration
    from lifecycle_msgs.srv import ChangeState
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    controller = [
        sys.executable,
        "-m",
        "rn_driver_ros2control.standin_node",
        "--joints",
        *ARM_JOINTS,
        "--start",
    ]
    controller += [str(value) for value in HOME_RAD]
    config = {
        "robot": {
            "name": "fr3",
            "driver": "ros2-control",
            "command_timeout_s": 5.0,
            "server_timeout_s": 60.0,
        },
        "plugins": {"fr3": {"connect_timeout_s": 60.0, "state_timeout_s": 3.0}},
    }
    settings = {
        "kind": "robot",
        "node_name": "robot",
        "config": config,
        "state_directory": str(tmp_path / "state"),
    }
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("mover", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    measured: dict[str, float] = {}
    node.create_subscription(
        JointState,
        "/fr3/joint_states",
        lambda m: measured.update(zip(m.name, m.position, strict=True)),
        1,
    )
    publisher = node.create_publisher(JointTrajectory, "/fr3/joint_trajectory", 1)

    def wait_for(condition: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < deadline_s, (
                f"{what}: {(tmp_path / 'robot.log').read_text()[-2000:]}"
            )
            executor.spin_once(timeout_sec=0.02)

    def reaches(step: float) -> bool:
        return abs(measured.get(ARM_JOINTS[6], np.inf) - HOME_RAD[6] - step) < 1e-3

    with (tmp_path / "robot.log").open("wb") as log:
        standin = subprocess.Popen(controller, stdout=log, stderr=log)
        module = subprocess.Popen(
            [sys.executable, "-m", "roboneuron.modules"],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
        )
    try:
        assert module.stdin is not None
        module.stdin.write(json.dumps(settings).encode() + b"\n")
        module.stdin.flush()
        client = node.create_client(ChangeState, "/fr3/robot/change_state")
        wait_for(client.service_is_ready, "the module to offer its lifecycle")
        for transition in (1, 3):  # configure, activate
            request = ChangeState.Request()
            request.transition.id = transition
            future = client.call_async(request)
            wait_for(future.done, f"transition {transition}")
            assert future.result().success, (tmp_path / "robot.log").read_text()
        wait_for(lambda: reaches(0.0) and publisher.get_subscription_count() > 0, "joint states")
        point = JointTrajectoryPoint(
            positions=[*HOME_RAD[:6], HOME_RAD[6] + 0.2], time_from_start=Duration(sec=1)
        )
        publisher.publish(JointTrajectory(joint_names=list(ARM_JOINTS), points=[point]))
        wait_for(lambda: reaches(0.2), "the motion")
    finally:
        assert module.stdin is not None
        module.stdin.close()  # the module leaves with its parent
        module.wait(timeout=30)
        standin.terminate()
        standin.wait(timeout=30)
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
