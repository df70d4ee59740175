"""The other ends of a topic, service or action, and their compatibility: another ROS, another DDS,
another quality of service.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from roboneuron.direct_path.type_hashes import BARE, KNOWN, NAMELESS, check_type_hash
from roboneuron.errors import ConfigurationError

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.topic_endpoint_info import TopicEndpointInfo

__all__ = ["GraphSurvey", "NodeDdsGraph"]
"""Names that other distributions may use."""

HUMBLE = (
    "A process announces its nodes without type hashes, as ROS 2 Humble and older do: a type that "
    "differs is not noticed, and the discovery messages of newer nodes can use up its memory."
)
HUMBLE_HINT = (
    "Give the two different values of ROS_DOMAIN_ID, and pass what both need through a bridge; or "
    "update the older one."
)
_DISCOVERY = "ros_discovery_info"
"""The topic on which each process with ROS nodes publishes the endpoints of its nodes."""
_CYCLONE = "Cyclone DDS"
_VENDORS = {
    b"\x01\x01": "Connext DDS",
    b"\x01\x0f": "Fast DDS",
    b"\x01\x10": _CYCLONE,
}
"""DDS vendors by the first bytes of a GUID. Source: DDSI-RTPS 2.5, 9.3.1; list of vendors of the
OMG.
"""
_PREFIX = 12
"""Bytes of a GUID that identify its participant."""
_SERVERS = {
    "service": (("_Request", "rq{}Request"), ("_Response", "rr{}Reply")),
    "action": (
        ("_SendGoal_Request", "rq{}/_action/send_goalRequest"),
        ("_GetResult_Response", "rr{}/_action/get_resultReply"),
        ("_FeedbackMessage", "rt{}/_action/feedback"),
    ),
}
"""Endpoints that show a server's definition: part of the type, and DDS topic. A server subscribes
to requests (`rq`), and publishes the others.
"""
_MOST = 5


class DdsGraph(Protocol):
    """A graph with the DDS names of topics: `rt/chatter`, `rq/addRequest`; implemented by
    `Host.graph`.
    """

    def dds_publishers(self, topic: str) -> Sequence[TopicEndpointInfo]:
        """Publishers of a topic."""

    def dds_subscriptions(self, topic: str) -> Sequence[TopicEndpointInfo]:
        """Subscriptions to a topic."""


class NodeDdsGraph:
    """The graph as discovered by a node."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def dds_publishers(self, topic: str) -> Sequence[TopicEndpointInfo]:
        """See `DdsGraph`."""
        return list(self._node.get_publishers_info_by_topic(topic, True))

    def dds_subscriptions(self, topic: str) -> Sequence[TopicEndpointInfo]:
        """See `DdsGraph`."""
        return list(self._node.get_subscriptions_info_by_topic(topic, True))


def both_ends(graph: DdsGraph, topic: str) -> list[TopicEndpointInfo]:
    """Publishers and subscriptions of a topic."""
    return [*graph.dds_publishers(topic), *graph.dds_subscriptions(topic)]


def participant_of(info: TopicEndpointInfo) -> bytes:
    """The participant of an endpoint: a process, or one of its ROS contexts."""
    return bytes(info.endpoint_gid[:_PREFIX])


def vendor_of(info: TopicEndpointInfo) -> str:
    """Vendor of an endpoint's DDS."""
    return _VENDORS.get(bytes(info.endpoint_gid[:2]), "another DDS")


def old_participants(graph: DdsGraph) -> frozenset[bytes]:
    """Participants with ROS 2 Humble or older: they announce their nodes, but send no type hash of
    that message.
    """
    return frozenset(
        participant_of(info)
        for info in graph.dds_publishers(_DISCOVERY)
        if not str(info.topic_type_hash).startswith(KNOWN)
    )


def name_of(info: TopicEndpointInfo, old: frozenset[bytes]) -> str:
    """Name of an endpoint's node, or a description without a node.

    Args:
        info: the endpoint.
        old: from `old_participants`, whose node names are unknown here.
    """
    if participant_of(info) in old:
        return "a node of ROS 2 Humble or older"
    if info.node_name == BARE:
        return f"a program that uses {vendor_of(info)} without ROS"
    if info.node_name == NAMELESS:
        return "a node"
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def qos_mismatches(graph: DdsGraph, topic: str, old: frozenset[bytes]) -> list[str]:
    """Publishers with a QoS incompatible with a subscribing node, with the policies; a sentence
    each.

    A node may subscribe several times, so that each publisher matches one of its subscriptions.

    Args:
        graph: the ROS graph.
        topic: absolute, as in ROS.
        old: from `old_participants`.
    """
    from rclpy.qos import QoSCompatibility, qos_check_compatible  # heavy

    publishers = graph.dds_publishers(f"rt{topic}")
    subscriptions = graph.dds_subscriptions(f"rt{topic}") if publishers else []
    found: dict[str, None] = {}
    for publisher in publishers:
        by_node: dict[tuple[bytes, str], list[str]] = {}
        for subscription in subscriptions:
            verdict, reason = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
            node = (participant_of(subscription), name_of(subscription, old))
            reasons = by_node.setdefault(node, [])
            reasons.append(_words(reason) if verdict == QoSCompatibility.ERROR else "")
        for (_, node_name), reasons in by_node.items():
            if all(reasons):
                sentence = f"{node_name} gets nothing from {name_of(publisher, old)} on {topic}"
                found[f"{sentence}: {reasons[0]}."] = None
    return list(found)[:_MOST]


def _words(reason: str) -> str:
    """Convert rclpy's reason for incompatible profiles to words for a sentence."""
    parts = [part.removeprefix("ERROR: ") for part in reason.split(";")]
    return ", ".join(part[0].lower() + part[1:] for part in parts if part)


def check_server(kind: str, name: str, type_name: str, graph: DdsGraph) -> None:
    """Refuse a service or action whose server is incompatible.

    Args:
        kind: "service" or "action"; a read-only service counts as one.
        name: absolute.
        type_name: as in the exposure.
        graph: the ROS graph.

    Raises:
        ConfigurationError: a server has another definition of the type, or all servers use a DDS
            with another format of requests and answers.
    """
    for part, topic in _server_topics(kind):
        find = graph.dds_subscriptions if topic.startswith("rq") else graph.dds_publishers
        servers = find(topic.format(name))
        check_type_hash(name, type_name, servers, part)
        foreign = [vendor_of(info) for info in servers if is_foreign(info)]
        if servers and len(foreign) == len(servers):
            raise ConfigurationError(
                f"{name} is served through {foreign[0]}, and this server uses another DDS: between "
                "the two, topics work, services and actions do not.",
                hint="Start what serves it with the RMW_IMPLEMENTATION of this server "
                f"({_own_middleware()}).",
            )


def _server_topics(kind: str) -> tuple[tuple[str, str], ...]:
    return _SERVERS["action" if kind == "action" else "service"]


def is_foreign(info: TopicEndpointInfo) -> bool:
    """True if an endpoint's requests have another format than this process's: only Cyclone DDS puts
    the client's id before the request.

    Source: https://github.com/ros2/rmw_cyclonedds/issues/184.
    """
    return (vendor_of(info) == _CYCLONE) != ("cyclonedds" in _own_middleware())


def _own_middleware() -> str:
    from rclpy.utilities import get_rmw_implementation_identifier  # heavy

    return str(get_rmw_implementation_identifier())


@dataclass(frozen=True, kw_only=True, slots=True)
class GraphSurvey:
    """What is incompatible on a whole graph.

    Attributes:
        participants: their number, by the vendor of their DDS.
        problems: a fact, and what to do about it.
    """

    participants: Mapping[str, int]
    problems: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, names: Iterable[str], graph: DdsGraph) -> GraphSurvey:
        """Examine the topics with these DDS names."""
        old = old_participants(graph)
        vendors: dict[bytes, str] = {}
        topics_of_old: list[str] = []
        uncallable: list[str] = []
        mismatches: list[str] = []
        for name in sorted(names):
            ends = both_ends(graph, name)
            vendors |= {participant_of(info): vendor_of(info) for info in ends}
            kind, _, rest = name.partition("/")
            if kind == "rt":
                mismatches += qos_mismatches(graph, f"/{rest}", old)
                if any(participant_of(info) in old for info in ends):
                    topics_of_old.append(f"/{rest}")
            elif kind == "rq" and any(map(is_foreign, graph.dds_subscriptions(name))):
                uncallable.append(f"/{rest.removesuffix('Request')}")
        problems = []
        if old:
            where = f" Its topics: {_listed(topics_of_old)}." if topics_of_old else ""
            problems.append((f"{HUMBLE}{where}", HUMBLE_HINT))
        if uncallable:
            fact = f"Services of another DDS cannot be called: {_listed(uncallable)}."
            hint = "Start what serves them with the RMW_IMPLEMENTATION that is used here."
            problems.append((fact, hint))
        if mismatches:
            left = len(mismatches) - _MOST
            shown = [*mismatches[:_MOST], *([f"{left} more do not fit."] if left > 0 else [])]
            hint = "Give one of the two the quality of service of the other."
            problems.append((" ".join(shown), hint))
        return cls(participants=Counter(vendors.values()), problems=tuple(problems))


def _listed(names: list[str]) -> str:
    return ", ".join([*names[:_MOST], *(["..."] if len(names) > _MOST else [])])


def problems_of(kind: str, name: str, type_name: str, graph: DdsGraph) -> list[str]:
    """Problems of an exposed endpoint with all or some peers; a sentence each.

    Args:
        kind: "publish", "read", "service" or "action".
        name: absolute.
        type_name: as in the exposure.
        graph: the ROS graph.
    """
    found = []
    is_topic = kind in ("publish", "read")
    ends = both_ends(graph, f"rt{name}" if is_topic else _server_topics(kind)[0][1].format(name))
    try:
        if is_topic:
            check_type_hash(name, type_name, ends)
        else:
            check_server(kind, name, type_name, graph)
    except ConfigurationError as error:
        found.append(str(error))
    old = old_participants(graph)
    if is_topic:
        found += qos_mismatches(graph, name, old)
    if any(participant_of(info) in old for info in ends):
        found.append(f"{HUMBLE} {HUMBLE_HINT}")
    return found
