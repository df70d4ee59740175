"""Queries to the nodes of the running graph about unknown types."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from rn_interfaces.found import FoundDefinition, FoundDefinitions, Refusal
from rn_interfaces.graph import hashes_here, is_known, uses
from rn_interfaces.store import DefinitionStore, Name, parse_name
from rn_interfaces_learning.processes import definition_of, prefixes_of_processes
from roboneuron import ConfigurationError, NotReadyError

if TYPE_CHECKING:
    from type_description_interfaces.srv import (  # type: ignore[import-untyped]
        GetTypeDescription,
    )

    from roboneuron.command import RosLink

DISCOVERY_S, LONGEST_DISCOVERY_S = 2.0, 10.0
"""Shortest and longest time until the graph counts as discovered."""
SETTLED_S = 1.0
"""Time without a change after which discovery counts as complete."""
_LOOK_S = 0.1
ANSWER_S = 5.0
"""Longest wait for a node's answer."""


class TopicEndpoint(Protocol):
    """A publisher or subscription, as rclpy lists them."""

    node_name: str
    node_namespace: str
    topic_type_hash: object


class NodeGraph:
    """The graph as discovered by a command's own node."""

    def __init__(self, link: RosLink) -> None:
        self._link = link

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        return dict(self._link.node.get_topic_names_and_types())

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        return dict(self._link.node.get_service_names_and_types())

    def others(self) -> set[str]:
        """Full names of all nodes except this one."""
        node = self._link.node
        names = node.get_node_names_and_namespaces()
        return {f"{place.rstrip('/')}/{name}" for name, place in names if name != node.get_name()}

    def endpoints(self, topic: str) -> list[TopicEndpoint]:
        """Publishers and subscriptions."""
        return self._endpoints(topic)

    def service_endpoints(self, service: str) -> tuple[list[TopicEndpoint], list[TopicEndpoint]]:
        """Endpoints of a service's requests, and those of its responses."""
        return (
            self._endpoints(f"rq{service}Request", no_mangle=True),
            self._endpoints(f"rr{service}Reply", no_mangle=True),
        )

    def _endpoints(self, topic: str, *, no_mangle: bool = False) -> list[TopicEndpoint]:
        node = self._link.node
        return [
            *node.get_publishers_info_by_topic(topic, no_mangle),
            *node.get_subscriptions_info_by_topic(topic, no_mangle),
        ]

    def ask(self, node: str, name: Name, type_hash: str) -> GetTypeDescription.Response | str:
        """Query a node about a type that it uses; return its answer or the reason for a missing
        one.
        """
        from type_description_interfaces.srv import GetTypeDescription

        request = GetTypeDescription.Request(
            type_name=str(name), type_hash=type_hash, include_type_sources=True
        )
        service = f"{node}/get_type_description"
        if service not in self.services():
            return f"{node} does not serve get_type_description (ROS 2 before Iron does not)"
        answered = threading.Event()
        call = self._link.call(GetTypeDescription, service, request, answered.set)
        if not answered.wait(ANSWER_S):
            call.cancel()
            return f"{node} did not answer within {ANSWER_S:g} s"
        response = call.result()
        if response is None or not response.successful:
            return f"{node} says: {getattr(response, 'failure_reason', '')[:200]}"
        return response


def ask_nodes(
    graph: NodeGraph,
    store: DefinitionStore,
    prefixes: Callable[[], Sequence[Path]] = prefixes_of_processes,
) -> FoundDefinitions:
    """Ask the nodes for definitions of the messages that they publish or subscribe to.

    A node only answers for the hash of its type. For a service or action, ROS 2 announces the
    hashes of its parts only. So its definition is searched in the ament prefixes of this machine's
    processes, and accepted if it has the announced hashes.

    Args:
        graph: the queried graph.
        store: store of the learnt interfaces.
        prefixes: ament prefixes where definitions of services and actions may be.
    """
    found = FoundDefinitions()
    for name, topics in uses(graph).items():
        if name.kind == "msg":
            infos = [info for topic in topics for info in graph.endpoints(topic)]
            spoken = {str(name): _hashes(infos)}
        else:
            infos = []
            spoken = _part_hashes(graph, name, topics)
        here = hashes_here(store, name)
        if is_known(store, name) and all(has <= {here.get(one)} for one, has in spoken.items()):
            continue
        if any(len(hashes) > 1 for hashes in spoken.values()):
            listed = ", ".join(sorted(one for hashes in spoken.values() for one in hashes))
            found.refused[str(name)] = Refusal(
                f"Nodes disagree on it: {listed}.", "Build all of them from one definition."
            )
        elif name.kind == "msg":
            _ask(graph, name, infos, found)
        else:
            announced = {part: one for part, hashes in spoken.items() for one in hashes}
            _look_up(name, announced, prefixes(), found)
    return found


def _part_hashes(graph: NodeGraph, name: Name, places: Iterable[str]) -> dict[str, set[str]]:
    """Hashes announced by endpoints for the parts of a service or action, by full name of
    the part.
    """
    found: dict[str, set[str]] = {}

    def note(part: str, infos: Iterable[TopicEndpoint]) -> None:
        found.setdefault(f"{name}_{part}", set()).update(_hashes(infos))

    for place in places:
        if name.kind == "srv":
            requests, responses = graph.service_endpoints(place)
            note("Request", requests)
            note("Response", responses)
        else:
            note("SendGoal_Request", graph.service_endpoints(f"{place}/_action/send_goal")[0])
            note("GetResult_Response", graph.service_endpoints(f"{place}/_action/get_result")[1])
            note("FeedbackMessage", graph.endpoints(f"{place}/_action/feedback"))
    return found


def _look_up(
    name: Name, announced: Mapping[str, str], prefixes: Sequence[Path], found: FoundDefinitions
) -> None:
    if not announced:
        found.refused[str(name)] = Refusal(
            "Its nodes announce no hash (ROS 2 before Iron does not).", "Learn it from a folder."
        )
        return
    texts = definition_of(name, announced, prefixes)
    if name in texts:
        found.texts = {**texts, **found.texts}
        return
    found.refused[str(name)] = Refusal(
        "Nodes tell nobody the definition of a service or action, and no process of yours on this "
        "machine has that one.",
        f"Copy the folder share/{name.package} of its machine here and learn that.",
    )


def _hashes(infos: Iterable[TopicEndpoint]) -> set[str]:
    return {_hash_of(info) for info in infos if "INVALID" not in _hash_of(info)}


def _hash_of(info: TopicEndpoint) -> str:
    return str(info.topic_type_hash)


def _ask(
    graph: NodeGraph, name: Name, infos: Iterable[TopicEndpoint], found: FoundDefinitions
) -> None:
    reasons: dict[str, str] = {}
    for info in infos:
        node = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        if node in reasons:
            continue
        answer = graph.ask(node, name, _hash_of(info))
        if isinstance(answer, str):
            reasons[node] = answer
            continue
        texts = _texts(answer, node, {str(name): _hash_of(info)})
        if name in texts:
            found.texts = {**texts, **found.texts}
            return
        reasons[node] = f"{node} gives no .msg text of it"
    reason = "; ".join(reasons.values()) or "no node has it any more"
    found.refused[str(name)] = Refusal(f"{reason}.", "Learn it from a folder.")


def _texts(
    answer: GetTypeDescription.Response, node: str, hashes: Mapping[str, str]
) -> dict[Name, FoundDefinition]:
    found = {}
    for source in answer.type_sources:
        if source.encoding != "msg":
            continue
        try:
            name = parse_name(source.type_name)
        except ConfigurationError:
            continue  # an invalid message name cannot be used by one
        announced = {str(name): hashes[str(name)]} if str(name) in hashes else {}
        found[name] = FoundDefinition(source.raw_file_contents, f"node {node}", announced)
    return found


def wait_settled(
    graph: NodeGraph,
    now_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Wait until the graph has not changed for a while: a busy machine discovers slowly.

    Raises:
        NotReadyError: no other node was discovered in that time.
    """
    begun_s = changed_s = now_s()
    seen: object = None
    while now_s() - begun_s < LONGEST_DISCOVERY_S:
        others = graph.others()
        picture = others, graph.topics(), graph.services()
        if picture != seen:
            seen, changed_s = picture, now_s()
        is_quiet = now_s() - changed_s >= SETTLED_S and now_s() - begun_s >= DISCOVERY_S
        if others and is_quiet:
            return
        sleep(_LOOK_S)
    if not graph.others():
        raise NotReadyError(
            f"No other node was seen within {LONGEST_DISCOVERY_S:g} s.",
            hint="Compare ROS_DOMAIN_ID and the discovery range with those of the node that is "
            "to be asked.",
        )


def with_graph(look: Callable[[NodeGraph], FoundDefinitions]) -> FoundDefinitions:
    """Join ROS, wait until the graph is discovered, call `look`, and leave. Raises as
    `wait_settled`.
    """
    from roboneuron.command import RosLink, environment

    environment.prepare_environment()
    link = RosLink(f"roboneuron_ros_{os.getpid()}")
    link.open()
    try:
        graph = NodeGraph(link)
        wait_settled(graph)
        return look(graph)
    finally:
        link.close()
