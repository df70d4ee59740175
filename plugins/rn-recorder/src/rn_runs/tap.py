"""Subscriptions of the recorder: every topic that a pattern names, as serialized messages."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from importlib import import_module
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from rn_runs.files import Record
from rn_runs.images import IMAGE
from rn_runs.schemas import definition
from roboneuron.ros.qos import requested_qos

log = logging.getLogger(__name__)
LOOK_S = 0.1
_IMAGES, _OTHERS = 30, 200
"""Messages that may wait in the middleware while this process does not get on: about a second of each."""


class Tap:
    """Subscribes to what appears on the graph, and counts gaps in the publishers' own counts.

    Args:
        node: of this process.
        topics, exclude: absolute patterns as of `fnmatch`; hidden topics are left out.
        take: gets every message, on the executor's thread.
    """

    def __init__(
        self, node: Node, topics: Sequence[str], exclude: Sequence[str], take: Callable[[Record], None]
    ) -> None:
        self._node = node
        self._topics, self._exclude = tuple(topics), tuple(exclude)
        self._take = take
        self._found: dict[str, tuple[QoSProfile, Subscription]] = {}
        self._unusable: set[str] = set()
        self._single: set[str] = set()
        self._newest: dict[str, int] = {}
        self.received: Counter[str] = Counter()
        self.gaps: Counter[str] = Counter()
        node.create_timer(LOOK_S, self.look)

    def look(self) -> None:
        """Follow the graph: new topics, and publishers that came with another reliability."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._unusable or not self._is_wanted(topic):
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if not publishers:
                continue
            self._note_single(topic, len(publishers) == 1)
            is_image = types[0] == IMAGE
            qos = requested_qos(publishers, _IMAGES if is_image else _OTHERS)
            known = self._found.get(topic)
            if known is not None and known[0] == qos:
                continue
            if known is not None:
                self._node.destroy_subscription(known[1])
            self._subscribe(topic, types[0], qos)

    def _subscribe(self, topic: str, type_name: str, qos: QoSProfile) -> None:
        try:
            message_type = _message_class(type_name)
            definition(type_name)
        except (ImportError, AttributeError, FileNotFoundError, ValueError) as error:
            self._unusable.add(topic)
            log.warning("%s is not recorded: its type %s is not installed here (%s).", topic, type_name, error)
            return

        def deliver(data: bytes, info: dict[str, Any]) -> None:
            now_ns = time.time_ns()
            sequence = int(info.get("publication_sequence_number") or 0)
            self.received[topic] += 1
            if topic in self._single:
                before = self._newest.get(topic)
                self._newest[topic] = sequence
                if before is not None and sequence > before + 1:
                    self.gaps[topic] += sequence - before - 1
            self._take(Record(topic, type_name, now_ns, int(info.get("source_timestamp") or now_ns), sequence, data))

        self._found[topic] = (qos, self._node.create_subscription(message_type, topic, deliver, qos, raw=True))
        log.info("Recording %s (%s).", topic, type_name)

    def _note_single(self, topic: str, single: bool) -> None:
        if single:
            self._single.add(topic)
        else:
            self._single.discard(topic)
            self._newest.pop(topic, None)

    def _is_wanted(self, topic: str) -> bool:
        if any(part.startswith("_") for part in topic.split("/")):
            return False
        if any(fnmatchcase(topic, pattern) for pattern in self._exclude):
            return False
        return any(fnmatchcase(topic, pattern) for pattern in self._topics)


def _message_class(type_name: str) -> type:
    package, kind, name = type_name.split("/")
    found: type = getattr(import_module(f"{package}.{kind}"), name)
    return found
