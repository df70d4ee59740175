"""Topics without ROS: publishers and subscribers in the memory of one process."""

from __future__ import annotations

import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any, TypeVar

M = TypeVar("M")


class MemoryTopics:
    """Follows the protocol `Topics`; messages are delivered to subscribers synchronously, in the
    publisher's thread.

    Args:
        now_ns: clock for stamps; the system's wall clock if None.
        history: number of messages kept per topic.
    """

    def __init__(self, now_ns: Callable[[], int] | None = None, *, history: int = 100_000) -> None:
        self._now_ns = now_ns or time.time_ns
        self._subscribers: defaultdict[str, list[Callable[[Any], None]]] = defaultdict(list)
        self._advertised: list[tuple[str, type]] = []
        self._published: defaultdict[str, deque[object]] = defaultdict(
            lambda: deque(maxlen=history)
        )
        self._lock = threading.Lock()

    def subscribe(
        self,
        topic: str,
        message_type: type[M],
        callback: Callable[[M], None],
        *,
        best_effort: bool = False,
    ) -> None:
        """Call `callback` with every message published or delivered on `topic`."""
        with self._lock:
            self._subscribers[topic].append(callback)

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        """Return a function that publishes on `topic`."""
        with self._lock:
            self._advertised.append((topic, message_type))

        def publish(message: M) -> None:
            if not isinstance(message, message_type):
                raise TypeError(
                    f"{topic} carries {message_type.__name__}, got {type(message).__name__}"
                )
            with self._lock:
                self._published[topic].append(message)
            self.deliver(topic, message)

        return publish

    def publisher_types(self, topic: str) -> tuple[str, ...]:
        """Type of each publisher that `advertise` returned for `topic`; `deliver` has no
        publisher.
        """
        with self._lock:
            types = [message_type for name, message_type in self._advertised if name == topic]
        return tuple(f"{t.__module__.partition('.')[0]}/msg/{t.__name__}" for t in types)

    def now_ns(self) -> int:
        """Time of the clock [ns]."""
        return self._now_ns()

    def deliver(self, topic: str, message: object) -> None:
        """Deliver `message` to the subscribers of `topic`, as if another process published it."""
        with self._lock:
            subscribers = tuple(self._subscribers[topic])
        for callback in subscribers:
            callback(message)

    def published(self, topic: str) -> tuple[object, ...]:
        """Everything published on `topic` so far, oldest first."""
        with self._lock:
            return tuple(self._published[topic])

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the topics subscribed to or advertised."""
        with self._lock:
            return (
                *(t for t, callbacks in self._subscribers.items() if callbacks),
                *(t for t, _ in self._advertised),
            )
