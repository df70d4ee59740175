"""Implementation of `Topics` for plugins in a module: publish and subscribe under the robot's
namespace only.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TypeVar

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from roboneuron.ros.executor import created
from roboneuron.ros.qos import NEWEST, requested_qos

M = TypeVar("M")
_LOOK_AGAIN_S = 0.25
"""Period at which a subscription adapts to publishers with another reliability."""


class NodeTopics:
    """Implements `roboneuron.contract.Topics` on a node; `close` destroys all entities.

    Callbacks run on the executor's thread of that node.
    """

    def __init__(self, node: Node, accepts: Callable[[], bool] = lambda: True) -> None:
        """Args:
        node: node of the module.
        accepts: checked before each message is delivered: a robot's driver receives nothing while
            the emergency stop is latched or its module is inactive.
        """
        self._node = node
        self._accepts = accepts
        self._made = ExitStack()

    def subscribe(
        self,
        topic: str,
        message_type: type[M],
        callback: Callable[[M], None],
        *,
        best_effort: bool = False,
    ) -> None:
        """See `Topics.subscribe`."""

        def deliver(message: M) -> None:
            if self._accepts():
                callback(message)

        if best_effort:
            self._follow(topic, message_type, deliver)
        else:
            subscription = self._subscription(topic, message_type, deliver, NEWEST)
            self._made.callback(self._node.destroy_subscription, subscription)

    def _follow(self, topic: str, message_type: type[M], deliver: Callable[[M], None]) -> None:
        """Subscribe with the reliability of the topic's publishers, and adapt to later ones.

        DDS connects a subscription only with publishers that are at least as reliable, and a
        subscription cannot change its reliability: it is recreated.
        """
        node = self._node
        qos: QoSProfile | None = None
        subscription: Subscription | None = None

        def look() -> None:
            nonlocal qos, subscription
            wanted = requested_qos(node.get_publishers_info_by_topic(topic), 1, latched=False)
            if wanted != qos:
                if subscription is not None:
                    node.destroy_subscription(subscription)
                qos = wanted
                subscription = self._subscription(topic, message_type, deliver, wanted)

        look()
        # of the present subscription, not of the first one
        self._made.callback(lambda: node.destroy_subscription(subscription))
        self._made.callback(node.destroy_timer, node.create_timer(_LOOK_AGAIN_S, look))

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        """See `Topics.advertise`."""
        node = self._node
        publisher = created(
            node,
            "publisher",
            topic,
            message_type,
            lambda: node.create_publisher(message_type, topic, NEWEST),
        )
        self._made.callback(self._node.destroy_publisher, publisher)
        context = self._node.context

        def publish(message: M) -> None:
            # a plugin's own thread may be the last to notice that the process exits
            if context.ok():
                publisher.publish(message)

        return publish

    def _subscription(
        self, topic: str, message_type: type[M], deliver: Callable[[M], None], qos: QoSProfile
    ) -> Subscription:
        node = self._node
        return created(
            node,
            "subscription",
            topic,
            message_type,
            lambda: node.create_subscription(message_type, topic, deliver, qos),
        )

    def publisher_types(self, topic: str) -> tuple[str, ...]:
        """See `Topics.publisher_types`."""
        return tuple(
            str(info.topic_type) for info in self._node.get_publishers_info_by_topic(topic)
        )

    def now_ns(self) -> int:
        """See `Topics.now_ns`."""
        return int(self._node.get_clock().now().nanoseconds)

    def close(self) -> None:
        """Destroy all publishers and subscriptions made through this object."""
        self._made.close()
