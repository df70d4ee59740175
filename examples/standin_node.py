"""Runs the stand-ins for MoveIt and nav2: one node, one thread, until SIGINT or SIGTERM."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import rclpy
from builtin_interfaces.msg import Duration
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


def run_node(make_node: Callable[[], Node], offered: str) -> None:
    """Run a node until SIGINT or SIGTERM.

    Args:
        make_node: creates the node; the context is initialised.
        offered: text printed once its actions are available.
    """
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(make_node())
    print(offered, flush=True)
    try:
        with suppress(KeyboardInterrupt, ExternalShutdownException):
            executor.spin()
    except RCLError:
        if rclpy.ok():  # otherwise SIGTERM came between two waits
            raise
    rclpy.try_shutdown()


def to_duration(seconds: float) -> Duration:
    """Convert seconds to a message, to the nanosecond."""
    whole, part = divmod(round(seconds * 1e9), 1_000_000_000)
    return Duration(sec=whole, nanosec=part)
