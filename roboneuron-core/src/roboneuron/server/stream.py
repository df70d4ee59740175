"""The newest actions on the action topic, as the control plane receives them: values and DDS source times."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

_KEPT = 4096


class ActionStream:
    """Listens to `/<namespace>/action` until it is closed.

    Times are DDS source times [ns]: when the inference process sent the action, whatever the way to here took.
    """

    def __init__(self, link: RosLink, namespace: str) -> None:
        from std_msgs.msg import Float64MultiArray  # heavy

        from roboneuron.ros.qos import STATUS
        from roboneuron.ros.topics import ACTION

        self._lock = threading.Lock()
        self._actions: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_KEPT)

        def receive(message: Any, info: dict[str, Any]) -> None:
            with self._lock:
                self._actions.append((int(info["source_timestamp"]), tuple(message.data)))

        topic = f"/{namespace}/{ACTION}"
        # Many are kept in between: a busy control plane must not mistake its own delay for a missing action.
        subscription = link.on_executor(
            lambda: link.node.create_subscription(Float64MultiArray, topic, receive, STATUS)
        )
        self._end: Callable[[], object] = lambda: link.on_executor(lambda: link.node.destroy_subscription(subscription))

    def close(self) -> None:
        """Stop listening."""
        self._end()

    def since(self, moment_ns: int) -> list[tuple[float, ...]]:
        """Values of the actions sent at or after a moment."""
        with self._lock:
            return [values for sent_ns, values in self._actions if sent_ns >= moment_ns]

    def newest(self, most: int) -> list[tuple[int, tuple[float, ...]]]:
        """The newest actions: source time [ns] and values, oldest first."""
        with self._lock:
            return list(self._actions)[-most:]

    def sent_ns(self) -> list[int]:
        """When the actions that are kept were sent [ns], oldest first."""
        with self._lock:
            return [at for at, _ in self._actions]
