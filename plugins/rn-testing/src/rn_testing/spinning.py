"""A test's own ROS node, next to the tested processes."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node


@contextmanager
def spinning_node(namespace: str, name: str = "witness") -> Iterator[Node]:
    """A node in its own context, spun by a thread until the end.

    Subscriptions may be created at any time; their callbacks run in that thread.
    """
    import rclpy  # heavy, and not there for every test
    from rclpy.executors import SingleThreadedExecutor  # likewise

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(name, namespace=namespace, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield node
    finally:
        stop.set()
        thread.join()
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.try_shutdown(context=context)
