"""Reading the next messages of a topic, with the quality of service of whoever publishes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from roboneuron.errors import ConfigurationError
from roboneuron.ros.live import requested_qos

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

    from roboneuron.ros.link import RosLink

_POLL_S = 0.02


@dataclass(kw_only=True, slots=True)
class Reading:
    """What came.

    Attributes:
        publishers: how many publish the topic.
        messages: in the order of arrival, each with the monotonic time at which it came.
    """

    publishers: int = 0
    messages: list[tuple[float, Any]] = field(default_factory=list)


class Cancelled(Exception):
    """Whoever asked does not wait any more."""


def read_messages(
    link: RosLink, message_type: type, type_name: str, topic: str, *, count: int, timeout_s: float,
    cancelled: threading.Event,
) -> Reading:  # fmt: skip
    """Subscribe, take the next `count` messages or what came in time, and unsubscribe; blocks.

    As long as nothing has come, the subscription follows who publishes: one that left a moment ago, and is still on the
    graph, does not decide for its successor.

    Raises:
        ConfigurationError: the topic carries another type.
        Cancelled: `cancelled` was set.
    """
    deadline_s = time.monotonic() + timeout_s
    reading = Reading()
    complete = threading.Event()
    unsubscribe: Callable[[], None] | None = None
    subscribed: QoSProfile | None = None

    def take(message: Any) -> None:
        if len(reading.messages) < count:
            reading.messages.append((time.monotonic(), message))
        if len(reading.messages) >= count:
            complete.set()

    try:
        while True:
            infos = [] if reading.messages else list(link.node.get_publishers_info_by_topic(topic))
            foreign = [info.topic_type for info in infos if info.topic_type != type_name]
            if foreign:
                raise ConfigurationError(f"Topic {topic} carries {foreign[0]}, it is exposed as {type_name}.")
            if infos:
                reading.publishers = len(infos)
                wanted = requested_qos(infos, count)
                if wanted != subscribed:
                    if unsubscribe is not None:
                        unsubscribe()
                    unsubscribe, subscribed = link.subscribe(message_type, topic, take, wanted), wanted
            remaining_s = deadline_s - time.monotonic()
            if complete.wait(max(0.0, min(_POLL_S, remaining_s))) or remaining_s <= 0:
                return reading
            if cancelled.is_set():
                raise Cancelled
    finally:
        if unsubscribe is not None:
            unsubscribe()


class NewestMessage:
    """A subscription that is kept, for facts that are needed at once (measured joints). Usable from any thread."""

    def __init__(self, link: RosLink, message_type: type, topic: str) -> None:
        self._link = link
        self._message_type = message_type
        self._topic = topic
        self._lock = threading.Lock()
        self._arrived = threading.Event()
        self._newest: tuple[float, Any] | None = None
        self._is_open = False

    def newest(self, max_age_s: float) -> Any:
        """The newest message if it is that young, else None; None as long as `open` was not called."""
        newest = self._newest
        return newest[1] if newest is not None and time.monotonic() - newest[0] <= max_age_s else None

    def open(self, timeout_s: float) -> None:
        """Subscribe, and wait for a first message for at most `timeout_s`."""
        with self._lock:
            if not self._is_open:
                infos = self._link.node.get_publishers_info_by_topic(self._topic)
                self._link.subscribe(self._message_type, self._topic, self._take, requested_qos(infos, 1))
                self._is_open = True
        self._arrived.wait(timeout_s)

    def _take(self, message: Any) -> None:
        self._newest = (time.monotonic(), message)
        self._arrived.set()
