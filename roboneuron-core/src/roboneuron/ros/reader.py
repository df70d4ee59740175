"""The newest message of a topic, with the quality of service of whoever publishes it."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

from roboneuron.ros.qos import requested_qos

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink


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
