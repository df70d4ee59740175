"""What the nodes of the running graph say about types that are unknown here."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from rn_interfaces.graph import hash_here, is_known, uses
from rn_interfaces.learning import Text
from rn_interfaces.store import Name, Store, parse_name
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from type_description_interfaces.srv import (  # type: ignore[import-untyped]
        GetTypeDescription,
    )

    from roboneuron.command import RosLink

DISCOVERY_S = 2.0
ANSWER_S = 5.0
"""Longest wait for a node's answer."""


class Endpoint(Protocol):
    """A publisher or subscription, as rclpy lists them."""

    node_name: str
    node_namespace: str
    topic_type_hash: object


@dataclass(kw_only=True, slots=True)
class Found:
    """What the graph says about types that are unknown here.

    Attributes:
        texts: definitions with the hash that their node has.
        unanswered: why there is none, by type.
    """

    texts: dict[Name, Text] = field(default_factory=dict)
    unanswered: dict[str, str] = field(default_factory=dict)


class NodeGraph:
    """The graph as a command sees it, from a node of its own."""

    def __init__(self, link: RosLink) -> None:
        self._link = link

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        return dict(self._link.node.get_topic_names_and_types())

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        return dict(self._link.node.get_service_names_and_types())

    def endpoints(self, topic: str) -> list[Endpoint]:
        """Publishers and subscriptions."""
        node = self._link.node
        return [
            *node.get_publishers_info_by_topic(topic),
            *node.get_subscriptions_info_by_topic(topic),
        ]

    def ask(self, node: str, name: Name, type_hash: str) -> GetTypeDescription.Response | str:
        """What a node answers about a type that it uses, or why it does not."""
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
            call.abandon()
            return f"{node} did not answer within {ANSWER_S:g} s"
        response = call.response
        if response is None or not response.successful:
            return f"{node} says: {getattr(response, 'failure_reason', '')[:200]}"
        return response


def ask_nodes(graph: NodeGraph, store: Store) -> Found:
    """Ask the nodes for definitions of the messages that they publish or subscribe to.

    Services and actions are reported only: a node gives a definition for the hash of its type, and
    ROS 2 tells others the hash of messages alone.
    """
    found = Found()
    for name, topics in uses(graph).items():
        if name.kind != "msg":
            if not is_known(store, name):
                found.unanswered[str(name)] = (
                    "nodes give no definitions of services and actions; learn it from a folder"
                )
            continue
        infos = [info for topic in topics for info in graph.endpoints(topic)]
        spoken = {str(info.topic_type_hash) for info in infos if "INVALID" not in _hash_of(info)}
        if is_known(store, name) and spoken <= {hash_here(store, name)}:
            continue
        if len(spoken) > 1:
            found.unanswered[str(name)] = f"nodes disagree on it: {', '.join(sorted(spoken))}"
            continue
        _ask(graph, name, infos, found)
    return found


def _hash_of(info: Endpoint) -> str:
    return str(info.topic_type_hash)


def _ask(graph: NodeGraph, name: Name, infos: Iterable[Endpoint], found: Found) -> None:
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
    found.unanswered[str(name)] = "; ".join(reasons.values()) or "no node has it any more"


def _texts(
    answer: GetTypeDescription.Response, node: str, hashes: Mapping[str, str]
) -> dict[Name, Text]:
    found = {}
    for source in answer.type_sources:
        if source.encoding != "msg":
            continue
        try:
            name = parse_name(source.type_name)
        except ConfigurationError:
            continue  # what is no name of a message cannot be used by one
        found[name] = Text(
            source.raw_file_contents, f"node {node}", hashes.get(source.type_name, "")
        )
    return found


def with_graph(look: Callable[[NodeGraph], Found]) -> Found:
    """Join ROS, wait until the graph is discovered, look, and leave."""
    from roboneuron.command import RosLink, environment

    environment.prepare_environment()
    link = RosLink(f"roboneuron_ros_{os.getpid()}")
    link.open()
    try:
        time.sleep(DISCOVERY_S)
        return look(NodeGraph(link))
    finally:
        link.close()
