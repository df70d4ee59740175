"""Subscriptions that a thread polls directly, without the node's executor."""

from __future__ import annotations

from contextlib import ExitStack

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Task


class PolledSubscriptions(ReentrantCallbackGroup):  # type: ignore[misc]
    """A callback group that the executor ignores.

    A message stays in the middleware, where a newer one replaces it, until `take` calls its
    callback on the caller's thread: no other thread has to wake. Used from one thread, which must
    end before a subscription is destroyed.
    """

    def __init__(self, node: Node) -> None:
        """Args:
        node: creates the subscriptions.
        """
        super().__init__()
        self._context = node.context
        self._subscriptions: list[Subscription] = []
        self._events: list[EventHandler] = []

    def add_entity(self, entity: Subscription | EventHandler) -> None:
        """Called by rclpy."""
        super().add_entity(entity)
        kept = self._subscriptions if isinstance(entity, Subscription) else self._events
        kept.append(entity)

    def can_execute(self, entity: Subscription | EventHandler) -> bool:
        """Called by rclpy. An executor that waited for the events alone would also wake for
        messages, repeatedly until they are taken.
        """
        return False

    def take(self, timeout_s: float) -> None:
        """Block until there is a message, or for `timeout_s` > 0; call the callbacks of the
        received messages, in the order of the subscriptions' creation.
        """
        with ExitStack() as held:
            wait_set = rclpy_implementation.WaitSet(
                *(len(self._subscriptions), 0, 0, 0, 0, len(self._events)), self._context.handle
            )
            wait_set.clear_entities()
            for subscription in self._subscriptions:
                held.enter_context(subscription.handle)
                wait_set.add_subscription(subscription.handle)
            for event in self._events:
                held.enter_context(event)
                event.add_to_wait_set(wait_set)
            wait_set.wait(int(timeout_s * 1e9))
            ready = [event for event in self._events if event.is_ready(wait_set)]
        for event in ready:
            Task(event.execute, (event.take_data(),))()
        for subscription in self._subscriptions:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is not None:
                subscription.callback(taken[0])
