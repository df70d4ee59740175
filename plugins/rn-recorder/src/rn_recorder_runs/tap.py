"""Subscriptions of the recorder: every topic that matches a pattern, as serialized messages, taken
in cycles.

There is no executor: it would take each message on arrival, just when an image is being processed
into an action. A cycle waits for an image, gives the control loop a head start, and then takes the
messages of all topics.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from importlib import import_module

# like rclpy.wait_for_message
from rclpy.impl.implementation_singleton import rclpy_implementation as ros
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from rn_recorder_runs.channels import describe_channel
from rn_recorder_runs.files import Record
from rn_recorder_runs.images import IMAGE
from rn_recorder_runs.schemas import definition
from roboneuron.command import qos as core_qos

log = logging.getLogger(__name__)
LOOK_S = 0.1
_IMAGES, _OTHERS = 30, 200
"""Queue lengths in the middleware while this process is delayed: about a second of messages
each.
"""
GIVE_WAY_S = 0.008
"""Head start of the control loop with an image: copying and encoding two of 640x480 take 8 ms of a
core, and a loop at 30 Hz has both cores of a small machine meanwhile.
"""
_TURN_S = 0.03


class TopicTap:
    """Subscribes to new topics on the graph, and counts gaps in the publishers' sequence numbers.

    Args:
        node: node of this process.
        topics, exclude: absolute patterns as for `fnmatch`; hidden topics are left out.
        take: called with every message, in the order of arrival, on the thread of `run`.
        describe: called with the publishers' QoS of a topic, before its messages and after each
            change.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        exclude: Sequence[str],
        take: Callable[[Record], None],
        describe: Callable[[str, Mapping[str, str]], None] = lambda topic, metadata: None,
    ) -> None:
        self._node = node
        self._topics, self._exclude = tuple(topics), tuple(exclude)
        self._take, self._describe = take, describe
        self._found: dict[str, tuple[QoSProfile, Subscription]] = {}
        self._types: dict[str, str] = {}
        self._unusable: set[str] = set()
        self._single: set[str] = set()
        self._newest: dict[str, int] = {}
        self.received: Counter[str] = Counter()
        self.gaps: Counter[str] = Counter()
        self._early: list[Record] = []

    def run(self, leaving: threading.Event, taken: Callable[[], object]) -> None:
        """Follow the graph and take messages until `leaving` is set; `taken` is called after each
        cycle.
        """
        looked_s = 0.0
        while not leaving.is_set():
            if time.monotonic() - looked_s >= LOOK_S:
                looked_s = time.monotonic()
                self.look()
            self._wait(leaving)
            self._turn()
            taken()

    def _wait(self, leaving: threading.Event) -> None:
        """Wait until an image has come and the control loop has had its head start, or for one
        cycle without an image.
        """
        images = [
            subscription for qos, subscription in self._found.values() if qos.depth == _IMAGES
        ]
        if not images:
            leaving.wait(_TURN_S)
            return
        waiting = ros.WaitSet(len(images), 0, 0, 0, 0, 0, self._node.context.handle)
        waiting.clear_entities()
        for subscription in images:
            waiting.add_subscription(subscription.handle)
        waiting.wait(round(_TURN_S * 1e9))
        if waiting.get_ready_entities("subscription"):
            leaving.wait(GIVE_WAY_S)

    def _turn(self) -> None:
        """Pass on the messages that arrived before this cycle; later ones wait for the next, to
        keep the order of topics.
        """
        begun_ns = time.time_ns()
        records, self._early = self._early, []
        for topic, (qos, subscription) in self._found.items():
            for _ in range(qos.depth):
                try:
                    taken = subscription.handle.take_message(subscription.msg_type, True)
                except ros.RCLError as error:  # of one sample; the other topics are recorded
                    log.warning("A message of %s cannot be recorded: %s", topic, error)
                    break
                if taken is None:
                    break
                record = self._record(topic, *taken)
                (records if record.log_ns < begun_ns else self._early).append(record)
        for record in sorted(records, key=lambda record: record.log_ns):
            self._take(record)

    def look(self) -> None:
        """Follow the graph: new topics, and publishers with a changed reliability."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._unusable or not self._is_wanted(topic):
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if not publishers:
                continue
            self._note_single(topic, len(publishers) == 1)
            self._describe(topic, describe_channel(publishers))
            is_image = types[0] == IMAGE
            qos = core_qos.requested_qos(publishers, _IMAGES if is_image else _OTHERS)
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
            self._leave_out(topic, f"its type {type_name} is not installed here ({error})")
            return

        def ignore(_: bytes) -> None:
            """No effect: messages are taken in cycles."""

        try:
            made = self._node.create_subscription(message_type, topic, ignore, qos, raw=True)
        except ros.RCLError:  # its text names neither the topic nor the cause
            self._leave_out(topic, f"this process uses it with another type than {type_name}")
            return
        self._found[topic] = qos, made
        self._types[topic] = type_name
        log.info("Recording %s (%s).", topic, type_name)

    def _leave_out(self, topic: str, reason: str) -> None:
        self._unusable.add(topic)
        self._found.pop(topic, None)
        log.warning("%s is not recorded: %s.", topic, reason)

    def _record(self, topic: str, data: bytes, info: Mapping[str, int]) -> Record:
        """Create the record of a message; counts it and the missing ones before it."""
        came_ns = int(info.get("received_timestamp") or time.time_ns())
        sequence = int(info.get("publication_sequence_number") or 0)
        self.received[topic] += 1
        if topic in self._single:
            before = self._newest.get(topic)
            self._newest[topic] = sequence
            if before is not None and sequence > before + 1:
                self.gaps[topic] += sequence - before - 1
        return Record(
            topic,
            self._types[topic],
            came_ns,
            int(info.get("source_timestamp") or came_ns),
            sequence,
            data,
        )

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
