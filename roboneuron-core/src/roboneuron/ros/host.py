"""The `Topics` that a module lends to its plugin: publish and subscribe under the robot's namespace, nothing else."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.qos import QoSProfile

from roboneuron.ros.qos import NEWEST, requested_qos

M = TypeVar("M")
_LOOK_AGAIN_S = 0.25
"""How soon a subscription follows publishers that came with another reliability."""


class _FollowingSubscription:
    """A subscription that is as reliable as the topic's publishers are; used on the executor's thread."""

    def __init__(self, node: Node, topic: str, message_type: type, deliver: Callable[[Any], None]) -> None:
        self._node = node
        self._topic = topic
        self._message_type = message_type
        self._deliver = deliver
        self._qos = self._wanted()
        self._subscription = self._create()
        self._timer = node.create_timer(_LOOK_AGAIN_S, self._look)

    def destroy(self) -> None:
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)

    def _create(self) -> object:
        return self._node.create_subscription(self._message_type, self._topic, self._deliver, self._qos)

    def _wanted(self) -> QoSProfile:
        return requested_qos(self._node.get_publishers_info_by_topic(self._topic), 1, latched=False)

    def _look(self) -> None:
        wanted = self._wanted()
        if wanted != self._qos:
            self._qos = wanted
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._create()


class NodeTopics:
    """Implements `roboneuron.contract.Topics` on a node; `close` takes everything back.

    `accepts` is asked before each message is delivered: a robot's driver hears nothing while the emergency stop is
    latched or its module is not active.
    """

    def __init__(self, node: Node, accepts: Callable[[], bool] = lambda: True) -> None:
        self._node = node
        self._accepts = accepts
        self._made = ExitStack()

    def subscribe(
        self, topic: str, message_type: type[M], callback: Callable[[M], None], *, best_effort: bool = False
    ) -> None:
        """See `Topics.subscribe`."""

        def deliver(message: M) -> None:
            if self._accepts():
                callback(message)

        if best_effort:
            self._made.callback(_FollowingSubscription(self._node, topic, message_type, deliver).destroy)
        else:
            subscription = self._node.create_subscription(message_type, topic, deliver, NEWEST)
            self._made.callback(self._node.destroy_subscription, subscription)

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        """See `Topics.advertise`."""
        publisher = self._node.create_publisher(message_type, topic, NEWEST)
        self._made.callback(self._node.destroy_publisher, publisher)
        context = self._node.context

        def publish(message: M) -> None:
            if context.ok():
                publisher.publish(message)

        return publish

    def publisher_types(self, topic: str) -> tuple[str, ...]:
        """See `Topics.publisher_types`."""
        return tuple(str(info.topic_type) for info in self._node.get_publishers_info_by_topic(topic))

    def now_ns(self) -> int:
        """See `Topics.now_ns`."""
        return int(self._node.get_clock().now().nanoseconds)

    def close(self) -> None:
        """Destroy all publishers and subscriptions made through this object."""
        self._made.close()
