"""The camera and the arm of bench_execution.py: inputs of the real inference process, and
measurement of its outputs.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from execution_plugin import SIDE_PX, STEP_S
from numpy.typing import NDArray

F64 = NDArray[np.float64]
CAMERA_HZ = 30.0
LAG_S = 0.020
FOUND_S, FIRST_ACTION_S, GONE_S = 30.0, 30.0, 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Measured:
    """Measurements on the action topic, and the final status.

    Attributes:
        rate: ratio of actions to periods, from the first to the last of the run.
        starved_periods: periods without an action.
        longest_gap_s: between two actions [s].
        late_ticks: ticks that were half a period late in a thread that only sleeps with the same
            period; the machine causes them.
        status: the metrics `execution.*` of the inference module, without that prefix.
    """

    rate: float
    starved_periods: int
    longest_gap_s: float
    late_ticks: int
    status: dict[str, str]


class Cell:
    """Publishes images that contain the TCP, executes actions with a lag, and notes their
    arrival.
    """

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import Image
        from std_msgs.msg import Float64MultiArray

        rclpy.init()
        self.node = rclpy.create_node("cell")
        self._lock = threading.Lock()
        self._arrivals_s: list[float] = []
        self._status: dict[str, str] = {}
        self._start_m, self._goal_m, self._since_s = np.zeros(3), np.zeros(3), 0.0
        self._image = np.random.default_rng(0).integers(
            0, 255, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8
        )
        self._publisher = self.node.create_publisher(
            Image, "/bench/camera/front/image", QoSProfile(depth=1)
        )
        self.node.create_subscription(
            Float64MultiArray, "/bench/action", self._on_action, QoSProfile(depth=50)
        )
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, QoSProfile(depth=50)
        )
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._spin, self._film)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Shut the node down."""
        import rclpy

        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)
        self.node.destroy_node()
        rclpy.try_shutdown()

    def wait_for_peer(self) -> None:
        """Wait until exactly one process subscribes to images and one publishes actions, and the
        first action has arrived.
        """
        _wait(self._is_found, FOUND_S, "the inference process was not found")
        _wait(lambda: bool(self._arrivals_s), FIRST_ACTION_S, "no action came")

    def wait_until_alone(self) -> None:
        """Wait until no process publishes actions any more, then reset."""
        _wait(
            lambda: not self.node.count_publishers("/bench/action"),
            GONE_S,
            "the ended process stayed in the graph",
        )
        with self._lock:
            self._arrivals_s.clear()
            self._status.clear()
            self._start_m, self._goal_m = np.zeros(3), np.zeros(3)

    def measure(self, warm_up_s: float, duration_s: float) -> Measured:
        """Count the actions within `duration_s`, after `warm_up_s` in which the mode is chosen."""
        time.sleep(warm_up_s)
        with self._lock:
            self._arrivals_s.clear()
        late_ticks = _sleep(duration_s)
        with self._lock:
            gaps_s, status = np.diff(self._arrivals_s), dict(self._status)
        if not gaps_s.size:
            raise SystemExit(f"fewer than two actions came within {duration_s:g} s")
        return Measured(
            rate=gaps_s.size * STEP_S / float(gaps_s.sum()),
            starved_periods=int(sum(max(0, int(gap_s / STEP_S + 0.5) - 1) for gap_s in gaps_s)),
            longest_gap_s=float(gaps_s.max()),
            late_ticks=late_ticks,
            status=status,
        )

    def _is_found(self) -> bool:
        return (
            self._publisher.get_subscription_count() == 1
            and self.node.count_publishers("/bench/action") == 1
        )

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    def _film(self) -> None:
        from roboneuron.contract import Frame
        from roboneuron.ros.messages import to_image

        next_s = time.monotonic()
        while not self._stop.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + 1.0 / CAMERA_HZ, time.monotonic())
            with self._lock:
                tcp_m = self._tcp_m(time.monotonic())
            self._image.reshape(-1)[:24] = np.frombuffer(tcp_m.tobytes(), dtype=np.uint8)
            stamp_ns = self.node.get_clock().now().nanoseconds
            frame = Frame(
                camera="front", image=self._image.copy(), stamp_ns=stamp_ns, frame_id="front"
            )
            self._publisher.publish(to_image(frame))

    def _tcp_m(self, now_s: float) -> F64:
        left: F64 = (self._start_m - self._goal_m) * math.exp(-(now_s - self._since_s) / LAG_S)
        return self._goal_m + left

    def _on_action(self, message: Any) -> None:
        now_s = time.monotonic()
        with self._lock:
            self._arrivals_s.append(now_s)
            self._start_m = self._tcp_m(now_s)
            self._goal_m, self._since_s = self._start_m + np.array(message.data[:3]), now_s

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            with self._lock:
                for key, value in values.items():
                    if key.startswith("execution."):
                        self._status[key.removeprefix("execution.")] = value


def _sleep(duration_s: float) -> int:
    """Sleep period by period; returns how many periods ended half a period late or more."""
    start_s, late = time.monotonic(), 0
    for tick in range(1, round(duration_s / STEP_S) + 1):
        due_s = start_s + tick * STEP_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        late += time.monotonic() - due_s >= 0.5 * STEP_S
    return late


def _wait(condition: Any, most_s: float, otherwise: str) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        if time.monotonic() > end_s:
            raise SystemExit(f"{otherwise} within {most_s:g} s")
        time.sleep(0.02)
