"""What the ROS graph shows of a topic now, and the quality of service that fits it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

_DEPTH = 10


def offered_qos(subscriptions: Sequence[Any]) -> QoSProfile:
    """The profile of a publisher that every given subscription (TopicEndpointInfo) matches.

    Reliable always fits; durability, deadline and liveliness are the strictest that anybody asks for.
    """
    profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
    asked = [info.qos_profile for info in subscriptions]
    if any(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in asked):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    deadlines = [qos.deadline.nanoseconds for qos in asked if qos.deadline.nanoseconds > 0]
    if deadlines:
        profile.deadline = Duration(nanoseconds=min(deadlines))
    if any(qos.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC for qos in asked):
        profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    leases = [q.liveliness_lease_duration.nanoseconds for q in asked if q.liveliness_lease_duration.nanoseconds > 0]
    if leases:
        profile.liveliness_lease_duration = Duration(nanoseconds=min(leases))
    return profile


def requested_qos(publishers: Sequence[Any], depth: int) -> QoSProfile:
    """A subscription profile that every given publisher matches; it gets the latched value where all latch."""
    offered = [info.qos_profile for info in publishers]
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = bool(offered) and all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def qos_key(profile: QoSProfile) -> tuple[object, ...]:
    """What has to be the same for a publisher to be kept."""
    return (
        profile.durability,
        profile.deadline.nanoseconds,
        profile.liveliness,
        profile.liveliness_lease_duration.nanoseconds,
    )


def topic_types(node: Node) -> dict[str, list[str]]:
    """Types by absolute topic name, as far as the node has discovered."""
    return dict(node.get_topic_names_and_types())


def service_types(node: Node) -> dict[str, list[str]]:
    """Types by absolute service name."""
    return dict(node.get_service_names_and_types())


def action_types(node: Node) -> dict[str, list[str]]:
    """Types by absolute action name."""
    from rclpy.action.graph import get_action_names_and_types

    return dict(get_action_names_and_types(node))


def node_names(node: Node) -> list[str]:
    """Absolute names of all nodes, each once: ROS lets several nodes, and for a while dead ones, share a name."""
    return sorted({f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()})


def used_names(node: Node) -> dict[str, dict[str, str]]:
    """Type by absolute name for each kind of use: "publish" where others subscribe, "read" where others publish, ...

    Names that carry several types are left out.
    """
    topics = {name: types[0] for name, types in topic_types(node).items() if len(types) == 1}
    return {
        "publish": {n: t for n, t in topics.items() if _others(node.get_subscriptions_info_by_topic(n), node)},
        "read": {n: t for n, t in topics.items() if _others(node.get_publishers_info_by_topic(n), node)},
        "service": {n: types[0] for n, types in service_types(node).items() if len(types) == 1},
        "action": {n: types[0] for n, types in action_types(node).items() if len(types) == 1},
    }


def _others(infos: Sequence[Any], node: Node) -> bool:
    """Whether somebody else than this node is there."""
    return any(info.node_name != node.get_name() for info in infos)
