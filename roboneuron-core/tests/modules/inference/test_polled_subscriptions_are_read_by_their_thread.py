"""Polled subscriptions: the executor leaves them alone, their own thread takes the newest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_until
from roboneuron.modules.inference.polled import PolledSubscriptions
from roboneuron.ros.qos import NEWEST

pytestmark = pytest.mark.ros


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    context = rclpy.Context()
    context.init(domain_id=free_ros_domain())
    node = rclpy.create_node("polled", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


@pytest.fixture
def executor(node: Any) -> SingleThreadedExecutor:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    return executor


def _publish(node: Any, *numbers: int) -> None:
    """Each has arrived in the reader's queue when this returns."""
    publisher = node.create_publisher(Int32, "number", NEWEST)
    wait_until(lambda: publisher.get_subscription_count() == 1)
    for number in numbers:
        publisher.publish(Int32(data=number))
    assert publisher.wait_for_all_acked(Duration(seconds=10))


def test_a_message_waits_for_its_thread_and_a_newer_one_replaces_it(
    node: Any, executor: SingleThreadedExecutor
) -> None:
    polled, taken = PolledSubscriptions(node), []
    node.create_subscription(Int32, "number", taken.append, NEWEST, callback_group=polled)
    _publish(node, 1, 2, 3)
    executor.spin_once(timeout_sec=0.2)
    assert not taken
    polled.take(10.0)
    polled.take(0.01)
    assert [message.data for message in taken] == [3]


def test_the_executor_sleeps_while_a_message_waits(
    node: Any, executor: SingleThreadedExecutor
) -> None:
    polled = PolledSubscriptions(node)
    node.create_subscription(Int32, "number", print, NEWEST, callback_group=polled)
    _publish(node, 1)
    executor.spin_once(timeout_sec=0.1)
    begun_s = time.thread_time()
    executor.spin_once(timeout_sec=0.5)
    # 0.002 s; an executor that wakes for the message again and again uses all of the time
    assert time.thread_time() - begun_s < 0.05


def test_messages_are_taken_in_the_order_of_their_subscriptions(node: Any) -> None:
    polled, taken = PolledSubscriptions(node), []
    for name in ("first", "second"):
        node.create_subscription(
            Int32, "number", lambda _, name=name: taken.append(name), NEWEST, callback_group=polled
        )
    publisher = node.create_publisher(Int32, "number", NEWEST)
    wait_until(lambda: publisher.get_subscription_count() == 2)
    publisher.publish(Int32(data=1))
    assert publisher.wait_for_all_acked(Duration(seconds=10))
    polled.take(10.0)
    assert taken == ["first", "second"]


def test_a_wait_without_messages_ends_in_time(node: Any) -> None:
    polled = PolledSubscriptions(node)
    node.create_subscription(Int32, "number", print, NEWEST, callback_group=polled)
    begun_s = time.monotonic()
    polled.take(0.2)
    assert time.monotonic() - begun_s >= 0.19


def test_a_publisher_that_cannot_be_heard_is_noticed(node: Any) -> None:
    polled, events = PolledSubscriptions(node), []
    callbacks = SubscriptionEventCallbacks(incompatible_qos=events.append)
    node.create_subscription(
        Int32, "number", print, NEWEST, callback_group=polled, event_callbacks=callbacks
    )
    unheard = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_publisher(Int32, "number", unheard)
    wait_until(lambda: polled.take(0.1) or bool(events))
    assert events[0].total_count == 1
