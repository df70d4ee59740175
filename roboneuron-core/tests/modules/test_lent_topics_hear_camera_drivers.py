"""Topics lent to a plugin by `NodeTopics`: subscriptions that match their publishers' reliability,
and the types of publishers.
"""

from __future__ import annotations

from typing import Any

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, String

from rn_testing.waiting import holds_within
from roboneuron.ros.host import NodeTopics
from roboneuron.ros.qos import NEWEST

pytestmark = pytest.mark.ros
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def deliver_until(
    world: Any,
    publisher: Any,
    heard: list[Any],
) -> bool:
    def was_heard() -> bool:
        publisher.publish(String(data="click"))
        return bool(heard)

    return holds_within(was_heard)


def test_subscription_follows_a_driver_from_best_effort_to_reliable(world: Any) -> None:
    heard: list[String] = []
    topics = NodeTopics(world.node)
    world.run(lambda: topics.subscribe("clicks", String, heard.append, best_effort=True))
    for qos in (BEST_EFFORT, NEWEST):
        publisher = world.run(lambda qos=qos: world.node.create_publisher(String, "clicks", qos))
        heard.clear()
        assert deliver_until(world, publisher, heard), qos
        world.run(lambda publisher=publisher: world.node.destroy_publisher(publisher))
    world.run(topics.close)
    assert world.node.count_subscribers("clicks") == 0


def test_publishers_are_told_by_type(world: Any) -> None:
    topics = NodeTopics(world.node)
    assert topics.publisher_types("clicks") == ()
    world.run(lambda: world.node.create_publisher(Bool, "clicks", 1))
    assert holds_within(lambda: topics.publisher_types("clicks") == ("std_msgs/msg/Bool",))
