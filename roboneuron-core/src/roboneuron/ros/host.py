"""The `Topics` that a module lends to its plugin: publish and subscribe under the robot's namespace, nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rclpy.node import Node

from roboneuron.ros.qos import NEWEST

M = TypeVar("M")


class NodeTopics:
    """Implements `roboneuron.contract.Topics` on a node; `close` takes everything back.

    `accepts` is asked before each message is delivered: a robot's driver hears nothing while the emergency stop is
    latched or its module is not active.
    """

    def __init__(self, node: Node, accepts: Callable[[], bool] = lambda: True) -> None:
        self._node = node
        self._accepts = accepts
        self._subscriptions: list[object] = []
        self._publishers: list[object] = []

    def subscribe(self, topic: str, message_type: type[M], callback: Callable[[M], None]) -> None:
        """See `Topics.subscribe`."""

        def deliver(message: M) -> None:
            if self._accepts():
                callback(message)

        self._subscriptions.append(self._node.create_subscription(message_type, topic, deliver, NEWEST))

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        """See `Topics.advertise`."""
        publisher = self._node.create_publisher(message_type, topic, NEWEST)
        self._publishers.append(publisher)
        context = self._node.context

        def publish(message: M) -> None:
            if context.ok():
                publisher.publish(message)

        return publish

    def now_ns(self) -> int:
        """See `Topics.now_ns`."""
        return int(self._node.get_clock().now().nanoseconds)

    def close(self) -> None:
        """Destroy all publishers and subscriptions made through this object."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        self._subscriptions.clear()
        self._publishers.clear()
