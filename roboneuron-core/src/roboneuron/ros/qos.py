"""Quality of service of the contract's streams."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

NEWEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""Images, actions, states, commands: reliable, and only the newest counts (best effort loses large images)."""

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The emergency stop: late joiners receive the last value."""

STOP_REQUESTS = (LATCHED, NEWEST)
"""To hear every emergency stop, subscribe with each: one that asks for the last value never matches a publisher
that keeps none, such as `ros2 topic pub`."""

STATUS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=20,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""/diagnostics: several modules write to one topic."""


def sensor_subscription(publishers_reliable: bool) -> QoSProfile:
    """Depth 1, as reliable as the publishers are: a reliable subscription never matches a best-effort camera driver."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE if publishers_reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def are_publishers_reliable(node: Node, topic: str) -> bool:
    """False when any publisher of the topic is best effort; True without publishers."""
    infos = node.get_publishers_info_by_topic(topic)
    return all(info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in infos)
