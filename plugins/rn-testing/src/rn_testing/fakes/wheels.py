"""A robot's wheels on a ROS graph: records velocity commands."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Any


class CommandedWheels:
    """A subscriber of `cmd_vel` with its own ROS context.

    Attributes:
        speeds: linear x of each received message [m/s].
    """

    def __init__(self, domain: int, namespace: str = "gantry") -> None:
        import rclpy
        from geometry_msgs.msg import Twist
        from rclpy.executors import SingleThreadedExecutor

        self.speeds: list[float] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("wheels", namespace=namespace, context=self._context)
        self._node.create_subscription(Twist, "cmd_vel", self._take, 50)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _take(self, message: Any) -> None:
        self.speeds.append(message.linear.x)

    def _spin(self) -> None:
        from rclpy.exceptions import InvalidHandle
        from rclpy.executors import ExternalShutdownException

        with suppress(ExternalShutdownException, InvalidHandle):
            self._executor.spin()

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=2.0)
        self._node.destroy_node()
        self._context.try_shutdown()
