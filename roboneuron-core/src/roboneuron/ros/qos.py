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

STATUS = _reliable(20)
"""/diagnostics: several modules write to one topic."""


def usual_qos(topic: str) -> QoSProfile:
    """Return the profile of a contract stream, by the name of its topic."""
    return STATUS if topic == DIAGNOSTICS else NEWEST


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
