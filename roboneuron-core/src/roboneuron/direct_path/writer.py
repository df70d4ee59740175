"""Publishing and subscribing with the quality of service of the peers."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from opentelemetry import trace
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)

from roboneuron.direct_path.type_hashes import NAMELESS, check_type_hash
from roboneuron.errors import ConfigurationError
from roboneuron.ros.graph import server_node
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_TRAJECTORY

if TYPE_CHECKING:
    from rclpy.event_handler import QoSOfferedIncompatibleQoSInfo
    from rclpy.publisher import Publisher
    from rclpy.topic_endpoint_info import TopicEndpointInfo

    from roboneuron.ros.link import RosLink

_DEPTH = 10
_tracer = trace.get_tracer("roboneuron")
"""Active once a feature has set up the SDK."""
_UNSHOWN = "a setting of its DDS that ROS does not show, such as ownership"
_POLL_S = 0.005
_REPLACE_S = 0.5
"""Longest wait of a publisher that replaces another for the subscriptions of that one."""
_SETTLE_S = 0.03
"""Wait after the first match: until the other side has matched too, a volatile message would be
lost there.
"""
_RECORDER = re.compile(r"recorder_\d+")
"""Node of the server's own recorder, which subscribes to what it records: no robot."""
_KNOWN_S = 1.0
"""Longest wait for the names of nodes, twice the period of announcements: those of ROS 2 Humble and
older never come.
"""


def offered_qos(subscriptions: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the profile of a publisher that matches every given subscription.

    Reliable always matches; durability, deadline and liveliness are the strictest requested.
    """
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )
    asked = [info.qos_profile for info in subscriptions]
    if any(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in asked):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    deadlines = [qos.deadline.nanoseconds for qos in asked if qos.deadline.nanoseconds > 0]
    if deadlines:
        profile.deadline = Duration(nanoseconds=min(deadlines))
    if any(qos.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC for qos in asked):
        profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    leases = [
        q.liveliness_lease_duration.nanoseconds
        for q in asked
        if q.liveliness_lease_duration.nanoseconds > 0
    ]
    if leases:
        profile.liveliness_lease_duration = Duration(nanoseconds=min(leases))
    return profile


def qos_key(profile: QoSProfile) -> tuple[object, ...]:
    """Values that must be equal for a publisher to be reused."""
    return (
        profile.durability,
        profile.deadline.nanoseconds,
        profile.liveliness,
        profile.liveliness_lease_duration.nanoseconds,
    )


_COMMANDS = (f"/{JOINT_TRAJECTORY}", f"/{JOINT_COMMAND}")
_COMMAND_TYPES = ("trajectory_msgs/msg/JointTrajectory", "sensor_msgs/msg/JointState")
"""Last names of topics with joint commands, and what they carry."""


class TopicWriter:
    """Publisher of one topic; created without access to ROS, usable from any thread.

    Attributes:
        misfit: policies requested by the last incompatible subscription; empty if all match.
        has_new_misfit: it came after `connect`, which may find a profile that matches all.
    """

    def __init__(self, link: RosLink, message_type: type, type_name: str, topic: str) -> None:
        """Args:
        link: an open link.
        message_type, type_name: the rosidl class and its full name.
        topic: absolute.
        """
        self._link = link
        self._message_type = message_type
        self._type_name = type_name
        self.topic = topic
        # Joint commands name this server as their sender: the robot module keeps others from the
        # arm while it moves by them. The frame of joint positions has no other meaning.
        self._signature = ""
        if topic.endswith(_COMMANDS) and type_name in _COMMAND_TYPES:
            self._signature = server_node(os.getpid())
        # one `connect` at a time: it may replace the publisher by one with another profile
        self._lock = threading.Lock()
        self._publisher: Publisher | None = None
        self._key: tuple[object, ...] = ()
        # matched subscriptions at the newest look at their nodes, and how many are the recorder's
        self._looked_at, self._recorders = 0, 0
        self.has_new_misfit = False
        self.misfit = ""

    def matched(self) -> int:
        """Number of subscriptions that the next message reaches, without the recorder's; about 5 us
        while none comes or goes.
        """
        if self._publisher is None:
            return 0
        count = int(self._publisher.get_subscription_count())
        if count != self._looked_at:
            found = self._link.node.get_subscriptions_info_by_topic(self.topic)
            self._recorders = sum(map(_is_recorder, found))
            is_known = all(info.node_name != NAMELESS for info in found)
            self._looked_at = count if is_known else 0
        return max(0, count - self._recorders)

    def listening(self) -> int:
        """Number of subscriptions on the topic, matched or not, without the recorder's; creates no
        publisher.
        """
        return sum(not _is_recorder(info) for info in self._subscriptions())

    def connect(self, timeout_s: float) -> int:
        """Wait for a matched subscription; return their number, 0 after `timeout_s`.

        Raises:
            ConfigurationError: the topic has another type.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._lock:
            while True:
                count = self.matched()
                if count and not self.has_new_misfit:
                    return count
                self.has_new_misfit = False
                self._offer(offered_qos(self._subscriptions()))
                if self.matched():
                    self._await_other_side()
                    return self.matched()
                if time.monotonic() >= deadline_s:
                    return 0
                time.sleep(_POLL_S)

    def _await_other_side(self) -> None:
        """Wait until the subscriptions have matched as well: this side may match up to a period of
        announcements earlier. A process sends its nodes' names once it has discovered this one, so
        that it will match too. Source: rmw_dds_common's graph cache.
        """
        end_s = time.monotonic() + _KNOWN_S
        while time.monotonic() < end_s and any(
            info.node_name == NAMELESS for info in self._subscriptions()
        ):
            time.sleep(_POLL_S)
        time.sleep(_SETTLE_S)

    def send(self, message: Any, stamped: bool) -> None:
        """Publish a command, with the present time in its header if `stamped`; requires a previous
        `connect`.
        """
        assert self._publisher is not None
        if self._signature:
            message.header.frame_id = self._signature
        if stamped:
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        if isinstance(trace.get_tracer_provider(), trace.ProxyTracerProvider):
            # tracing is off: entering and leaving an empty span costs 20 us
            self._publisher.publish(message)
            return
        with _tracer.start_as_current_span(f"publish {self.topic}", kind=trace.SpanKind.PRODUCER):
            self._publisher.publish(message)

    def publish(self, message: Any) -> None:
        """Publish; requires a previous `connect`."""
        assert self._publisher is not None
        if self._signature:
            message.header.frame_id = self._signature
        self._publisher.publish(message)

    def publish_if_possible(self, message: Any) -> None:
        """Publish, unless nothing is connected or the context is closed."""
        publisher = self._publisher
        if publisher is not None:
            if self._signature:
                message.header.frame_id = self._signature
            self._link.send_if_possible(publisher, message)

    def _subscriptions(self) -> list[TopicEndpointInfo]:
        found = list(self._link.node.get_subscriptions_info_by_topic(self.topic))
        foreign = [info.topic_type for info in found if info.topic_type != self._type_name]
        if foreign:
            raise ConfigurationError(
                f"Topic {self.topic} carries {foreign[0]}, it is exposed as {self._type_name}."
            )
        check_type_hash(self.topic, self._type_name, found)
        return found

    def _offer(self, profile: QoSProfile) -> None:
        """Create a publisher with this profile. One with another profile is replaced as soon as the
        new one has matched as many subscriptions, because other threads may be publishing.
        """
        key = qos_key(profile)
        if self._publisher is not None and key == self._key:
            return
        old, node = self._publisher, self._link.node
        self.misfit = ""

        def note(event: QoSOfferedIncompatibleQoSInfo) -> None:
            kind = QoSPolicyKind(event.last_policy_kind)
            self.misfit = _UNSHOWN if kind is QoSPolicyKind.INVALID else kind.name.lower()
            self.has_new_misfit = True

        made = self._link.create(
            "publisher",
            self.topic,
            self._message_type,
            lambda node: node.create_publisher(
                self._message_type,
                self.topic,
                profile,
                event_callbacks=PublisherEventCallbacks(incompatible_qos=note),
            ),
        )
        deadline_s = time.monotonic() + _REPLACE_S
        while self.matched() > made.get_subscription_count() and time.monotonic() < deadline_s:
            time.sleep(_POLL_S)
        self._publisher, self._key = made, key
        if old is not None:
            self._link.on_executor(lambda: node.destroy_publisher(old))


def _is_recorder(info: TopicEndpointInfo) -> bool:
    return info.node_namespace == "/" and _RECORDER.fullmatch(info.node_name) is not None


class NewestMessage:
    """A permanent subscription for values that are needed at once (measured joints). Usable from
    any thread.
    """

    def __init__(self, link: RosLink, message_type: type, topic: str) -> None:
        self._link = link
        self._message_type = message_type
        self.topic = topic
        # of several first callers only one subscribes
        self._lock = threading.Lock()
        self._arrived = threading.Event()
        self._newest: tuple[float, object] | None = None
        self._is_open = False

    def newest(self, max_age_s: float) -> Any:
        """Return the newest message if it is young enough, else None; None before `open`."""
        newest = self._newest
        return (
            newest[1] if newest is not None and time.monotonic() - newest[0] <= max_age_s else None
        )

    def open(self, timeout_s: float) -> None:
        """Subscribe, and wait for a first message for at most `timeout_s`."""
        with self._lock:
            if not self._is_open:
                self._link.follow(self._message_type, self.topic, self._take)
                self._is_open = True
        self._arrived.wait(timeout_s)

    def _take(self, message: object) -> None:
        self._newest = (time.monotonic(), message)
        self._arrived.set()
