"""QoS profiles of the contract's streams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from roboneuron.ros.topics import DIAGNOSTICS


def _reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


NEWEST = _reliable(1)
"""Images, actions, states, commands: reliable, keep the newest only (best effort loses large
images).
"""

LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""The emergency stop: late joiners receive the last value."""

STOP_REQUESTS = (LATCHED, NEWEST)
"""Profiles of the two subscriptions that together receive every emergency stop: a transient-local
subscription never matches a volatile publisher, such as `ros2 topic pub`.
"""

LARGE_TYPES = frozenset(
    {"sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/PointCloud2"}
)
"""Types whose messages are sent in fragments."""

STATUS = _reliable(20)
"""/diagnostics: several modules write to one topic."""


def usual_qos(topic: str) -> QoSProfile:
    """Return the profile of a contract stream, by the name of its topic."""
    return STATUS if topic == DIAGNOSTICS else NEWEST


def is_large(message_type: type) -> bool:
    """True for a rosidl class of one of `LARGE_TYPES`."""
    package = message_type.__module__.partition(".")[0]
    return f"{package}/{message_type.__name__}" in LARGE_TYPES


def large_qos(depth: int) -> QoSProfile:
    """Return the profile for `LARGE_TYPES` in a process whose subscriptions come and go.

    A reliable one that joins beside another can hang the process: Fast DDS 2.14 lets a GAP remove a
    sample of which only some fragments have come from one of its two lists, and `take` then tries
    for ever to read it, with the interpreter's lock held. Best-effort readers ignore GAPs.

    Source: Fast DDS 2.14.5, StatefulReader::processGapMsg, DataReaderHistory::remove_change_sub,
    StatelessReader::processDataFragMsg.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT
    )


def requested_qos(publishers: Sequence[Any], depth: int, *, latched: bool = True) -> QoSProfile:
    """Return a subscription profile that matches every given publisher; if `latched`, it receives
    the last value too.
    """
    offered = [info.qos_profile for info in publishers]
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = (
        latched
        and bool(offered)
        and all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    )
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
