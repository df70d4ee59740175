"""Metadata of a channel: the quality of service that publishers offer, as rosbag2 writes it.

Source: rosbag2_storage_mcap of ROS 2 Jazzy, keys `offered_qos_profiles` (YAML) and
`topic_type_hash`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rn_recorder_runs.files import LATCHED

if TYPE_CHECKING:
    from enum import IntEnum

    from rclpy.qos import QoSProfile
    from rclpy.topic_endpoint_info import TopicEndpointInfo

_TRANSIENT_LOCAL = "transient_local"
_FOREVER_NS = 2**63 - 1


def describe_channel(publishers: Sequence[TopicEndpointInfo]) -> dict[str, str]:
    """Metadata of a topic by what its publishers offer
    (`rclpy.node.Node.get_publishers_info_by_topic`).
    """
    profiles = [info.qos_profile for info in publishers]
    found = {"offered_qos_profiles": "".join(_to_yaml(profile) for profile in profiles)}
    kind = getattr(publishers[0], "topic_type_hash", None) if publishers else None
    if kind is not None:
        found["topic_type_hash"] = str(kind)
    if profiles and all(_word(profile.durability) == _TRANSIENT_LOCAL for profile in profiles):
        found[LATCHED] = "true"
    return found


def latched_channel() -> dict[str, str]:
    """Metadata of a topic that the recorder itself creates and that late readers need."""
    return {
        "offered_qos_profiles": _yaml("keep_last", 1, "reliable", _TRANSIENT_LOCAL),
        LATCHED: "true",
    }


def plain_channel() -> dict[str, str]:
    """Metadata of any other topic that the recorder creates."""
    return {"offered_qos_profiles": _yaml("keep_last", 100, "reliable", "volatile")}


def _to_yaml(profile: QoSProfile) -> str:
    durations = [
        int(getattr(profile, name).nanoseconds)
        for name in ("deadline", "lifespan", "liveliness_lease_duration")
    ]
    return _yaml(
        _word(profile.history),
        int(profile.depth),
        _word(profile.reliability),
        _word(profile.durability),
        _word(profile.liveliness),
        durations,
        bool(profile.avoid_ros_namespace_conventions),
    )


def _yaml(
    history: str,
    depth: int,
    reliability: str,
    durability: str,
    liveliness: str = "automatic",
    durations_ns: Sequence[int] = (_FOREVER_NS,) * 3,
    avoids_conventions: bool = False,
) -> str:
    """One entry of the list that rosbag2 reads."""
    deadline, lifespan, lease = (
        divmod(at_ns or _FOREVER_NS, 1_000_000_000) for at_ns in durations_ns
    )
    lines = [
        f"- history: {history}",
        f"  depth: {depth}",
        f"  reliability: {reliability}",
        f"  durability: {durability}",
        *_duration("deadline", deadline),
        *_duration("lifespan", lifespan),
        f"  liveliness: {liveliness}",
        *_duration("liveliness_lease_duration", lease),
        f"  avoid_ros_namespace_conventions: {str(avoids_conventions).lower()}",
    ]
    return "\n".join(lines) + "\n"


def _duration(name: str, parts: tuple[int, int]) -> list[str]:
    return [f"  {name}:", f"    sec: {parts[0]}", f"    nsec: {parts[1]}"]


def _word(policy: IntEnum) -> str:
    """A policy as rosbag2 names it."""
    return str(policy.name).lower()
