"""Values arrive equal in another process, over real topics, services and actions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import pytest

from rn_testing.domain import free_ros_domain
from roboneuron.tools.ros.interfaces import list_interfaces

pytest.importorskip("test_msgs", reason="pip install ros-jazzy-test-msgs")

NODE = Path(__file__).parent / "round_trip_node.py"
REPRESENTATIVE = (
    "std_msgs/msg/Empty",
    "std_msgs/msg/Float64",
    "std_msgs/msg/ByteMultiArray",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "trajectory_msgs/msg/JointTrajectory",
    "sensor_msgs/msg/PointCloud2",
    "diagnostic_msgs/msg/DiagnosticArray",
    "visualization_msgs/msg/Marker",
    "test_msgs/msg/Arrays",
    "test_msgs/msg/BoundedSequences",
    "test_msgs/msg/WStrings",
    "test_msgs/msg/MultiNested",
    "std_srvs/srv/SetBool",
    "test_msgs/srv/Arrays",
    "rcl_interfaces/srv/SetParameters",
    "test_msgs/action/Fibonacci",
)


class Child:
    """A child process that takes one line and gives JSON lines."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._lines: Queue[str] = Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)

    def join(self) -> None:
        """Wait until the process's output has ended."""
        self._reader.join(timeout=10)

    def next(self, timeout_s: float) -> dict[str, Any]:
        try:
            line = self._lines.get(timeout=timeout_s)
        except Empty:
            raise AssertionError(
                f"nothing within {timeout_s} s, exit code {self._process.poll()}"
            ) from None
        return dict(json.loads(line))


@contextmanager
def started(role: str, seed: int, names: list[str], domain: int) -> Iterator[Child]:
    environment = {
        **os.environ,
        "AMENT_PREFIX_PATH": sys.prefix,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    command = [sys.executable, str(NODE), role, str(seed)]
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    child = Child(process)
    try:
        process.stdin.write(json.dumps(names) + "\n")
        process.stdin.flush()
        yield child
    finally:
        process.stdin.close()
        process.terminate()
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(timeout=10)
        child.join()
        process.stdout.close()


def round_trip(names: list[str], seed: int, interface_values: Any, timeout_s: float) -> int:
    """Send everything once and compare all that was received at both ends; returns how many
    messages that were.
    """
    expected = {}
    for name in names:
        parts = interface_values.parts_of(name)
        words = {1: ("msg",), 2: ("request", "response"), 3: ("goal", "result", "feedback")}[
            len(parts)
        ]
        expected.update({(name, word): part for word, part in zip(words, parts, strict=True)})
    domain = free_ros_domain()
    with started("serve", seed, names, domain) as server:
        assert server.next(timeout_s) == {"ready": len(names)}
        with started("send", seed, names, domain) as sender:
            received = {}
            while "sent" not in (line := sender.next(timeout_s)):
                received[line["name"], line["part"]] = line["value"]
            while len(received) < len(expected):
                line = server.next(30)
                received[line["name"], line["part"]] = line["value"]
    for key, part in expected.items():
        value = interface_values.ValueGenerator(seed).value(part.message)
        assert interface_values.differences(part.message, value, received[key]) == [], key
    return len(expected)


@pytest.mark.ros
def test_values_of_typical_interfaces_arrive_equal_in_another_process(interface_values) -> None:
    assert round_trip(list(REPRESENTATIVE), 4, interface_values, timeout_s=60) == 13 + 3 * 2 + 3


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_values_of_every_interface_arrive_equal_in_another_process(interface_values) -> None:
    names = [str(name) for name in list_interfaces()]
    assert round_trip(names, 7, interface_values, timeout_s=240) >= 169 + 2 * 28 + 3 * 2
