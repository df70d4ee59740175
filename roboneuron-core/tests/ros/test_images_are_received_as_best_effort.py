"""Subscriptions of the server: large messages come as best effort, the others as reliably as they
are sent.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module", autouse=True)
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros")))
        prepare_environment()
        yield


def test_images_and_clouds_are_best_effort_and_arrive() -> None:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import CompressedImage, Image, JointState, PointCloud2

    from roboneuron.ros.link import RosLink
    from roboneuron.ros.qos import LATCHED

    link = RosLink("listener")
    link.open()
    reliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
    best_effort = ReliabilityPolicy.BEST_EFFORT
    wanted = [
        (Image, reliable, best_effort),
        (CompressedImage, reliable, best_effort),
        (PointCloud2, reliable, best_effort),
        # a late joiner gets the kept message only if it is reliable
        (PointCloud2, LATCHED, ReliabilityPolicy.RELIABLE),
        (JointState, reliable, ReliabilityPolicy.RELIABLE),
    ]
    try:
        for number, (kind, offered, reliability) in enumerate(wanted):
            topic, received = f"/large/topic{number}", list[object]()
            send = link.advertise(kind, topic, offered)
            wait_until(lambda topic=topic: link.node.count_publishers(topic) == 1, 10.0)
            end = link.follow(kind, topic, received.append)
            (info,) = link.node.get_subscriptions_info_by_topic(topic)
            assert info.qos_profile.reliability == reliability, topic
            is_kept = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert (info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL) == is_kept

            def arrives(send=send, kind=kind, received=received) -> bool:  # type: ignore[no-untyped-def]
                send(kind())
                return bool(received)

            wait_until(arrives, 10.0, poll_s=0.05)
            end()
    finally:
        link.close()


def test_a_publisher_that_comes_later_is_received_whatever_it_offers() -> None:
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    from roboneuron.ros.link import RosLink

    link, others = RosLink("early_listener"), RosLink("late_sender")
    link.open()
    others.open()
    topic, received = "/late/joint_states", list[object]()
    try:
        end = link.follow(JointState, topic, received.append)
        for reliability in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
            send = others.advertise(JointState, topic, QoSProfile(depth=1, reliability=reliability))
            name = reliability.name

            def arrives(send=send, name=name) -> bool:  # type: ignore[no-untyped-def]
                send(JointState(name=[name]))
                return any(list(message.name) == [name] for message in received)  # type: ignore[attr-defined]

            wait_until(arrives, 20.0, poll_s=0.05)
        end()
        wait_until(lambda: link.node.count_subscribers(topic) == 0, 10.0)
    finally:
        others.close()
        link.close()
