"""Two bases as module processes under their own namespaces, driven over ROS topics."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rn_testing.domain import free_ros_domain

pytestmark = pytest.mark.ros


class Graph:
    """A ROS node of the test, and the base processes that it started."""

    def __init__(self, folder: Path) -> None:
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
        from roboneuron.ros.environment import prepare_environment

        prepare_environment(folder)
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("driver_of_bases")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []

    def wait_for(self, condition: Callable[[], bool], what: str, limit_s: float = 30.0) -> None:
        deadline_s = time.monotonic() + limit_s
        while not condition():
            assert time.monotonic() < deadline_s, f"waited in vain: {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def start(self, robot: str, namespace: str) -> None:
        from lifecycle_msgs.srv import ChangeState

        config = {"robot": {"name": robot, "namespace": namespace}}
        state = str(self.folder / namespace)
        settings = {
            "kind": "robot",
            "node_name": "robot",
            "config": config,
            "state_directory": state,
        }
        with (self.folder / f"{namespace}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "roboneuron.modules"],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
            )
        self.processes.append(process)
        assert process.stdin is not None
        process.stdin.write(json.dumps(settings).encode() + b"\n")
        process.stdin.flush()
        client = self.node.create_client(ChangeState, f"/{namespace}/robot/change_state")
        self.wait_for(client.service_is_ready, f"{namespace} to offer its lifecycle")
        for transition in (1, 3):  # configure, activate
            request = ChangeState.Request()
            request.transition.id = transition
            future = client.call_async(request)
            self.wait_for(future.done, f"transition {transition} of {namespace}")
            assert future.result().success, (self.folder / f"{namespace}.log").read_text()

    def newest(self, message_type: Any, topic: str, qos: Any = 1) -> Callable[[], Any]:
        received: list[Any] = [None]
        self.node.create_subscription(
            message_type, topic, lambda message: received.__setitem__(0, message), qos
        )
        return lambda: received[0]

    def close(self) -> None:
        import rclpy

        for process in self.processes:
            assert process.stdin is not None
            process.stdin.close()  # as when the parent ends
        for process in self.processes:
            process.wait(15.0)
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    graph = Graph(tmp_path)
    yield graph
    graph.close()


def test_each_base_follows_its_own_namespace_and_its_own_emergency_stop(graph: Graph) -> None:
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Bool

    graph.start("diffdrive", "left")
    graph.start("racecar", "right")
    odometry = {name: graph.newest(Odometry, f"/{name}/odom") for name in ("left", "right")}
    wheels = graph.newest(JointState, "/right/joint_states")
    drive = {
        name: graph.node.create_publisher(Twist, f"/{name}/cmd_vel", 1)
        for name in ("left", "right")
    }
    stop = graph.node.create_publisher(
        Bool,
        "/right/emergency_stop",
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    )
    graph.wait_for(
        lambda: wheels() is not None and all(get() is not None for get in odometry.values()),
        "odometry",
    )
    assert "left_steering_hinge_joint" in wheels().name
    forwards = Twist()
    forwards.linear.x = 0.4

    def has_driven(name: str, far_m: float) -> bool:
        drive[name].publish(forwards)
        return bool(odometry[name]().pose.pose.position.x > far_m)

    graph.wait_for(lambda: has_driven("right", 0.3), "the car to drive 0.3 m")
    assert abs(odometry["left"]().pose.pose.position.x) < 0.01
    stop.publish(Bool(data=True))
    graph.wait_for(lambda: abs(odometry["right"]().twist.twist.linear.x) < 0.01, "the car to stop")
    stopped_m = odometry["right"]().pose.pose.position.x
    graph.wait_for(
        lambda: has_driven("left", 0.3) & has_driven("right", -1.0), "the other base to drive 0.3 m"
    )
    assert abs(odometry["right"]().pose.pose.position.x - stopped_m) < 0.01
    assert odometry["left"]().child_frame_id == "base_link"
