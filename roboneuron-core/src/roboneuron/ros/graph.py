"""The ROS graph as discovered by a node; does not import `rclpy`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.topic_endpoint_info import TopicEndpointInfo

_UNNAMED = "_NODE_NAME_UNKNOWN_"
"""rcl calls the node of an endpoint so that was discovered before its node."""


def server_node(pid: int) -> str:
    """Name of a server's node, by its process; in `header.frame_id` of a joint command it says that
    this server or its control has sent it, because ROS does not tell who sends a message.
    """
    return f"roboneuron_server_{pid}"


def foreign_names(found: Iterable[TopicEndpointInfo], own: Iterable[str] = ()) -> list[str]:
    """Sorted names of the nodes of these endpoints, other than the server that has started this
    process; unnamed ones are left out.

    Args:
        found: endpoints of a topic.
        own: names of further nodes to leave out.
    """
    names = {
        f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        for info in found
        if info.node_name != _UNNAMED
    }
    return sorted(names - {f"/{server_node(os.getppid())}", *own})


@dataclass(frozen=True, slots=True)
class RosGraph:
    """The ROS graph as discovered by the server's node; sends nothing."""

    _node: Node

    @property
    def node_name(self) -> str:
        """Name of the server's node, whose own endpoints are listed too."""
        return str(self._node.get_name())

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        return dict(self._node.get_topic_names_and_types())

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        return dict(self._node.get_service_names_and_types())

    def nodes(self) -> list[tuple[str, str]]:
        """Name and namespace of all nodes."""
        return list(self._node.get_node_names_and_namespaces())

    def publishers(self, topic: str) -> list[TopicEndpointInfo]:
        """Publishers of a topic."""
        return list(self._node.get_publishers_info_by_topic(topic))

    def subscriptions(self, topic: str) -> list[TopicEndpointInfo]:
        """Subscriptions to a topic."""
        return list(self._node.get_subscriptions_info_by_topic(topic))

    def dds_publishers(self, topic: str) -> list[TopicEndpointInfo]:
        """Publishers of a topic by its DDS name: `rt/chatter`, `rr/addReply`."""
        return list(self._node.get_publishers_info_by_topic(topic, True))

    def dds_subscriptions(self, topic: str) -> list[TopicEndpointInfo]:
        """Subscriptions to a topic by its DDS name: `rt/chatter`, `rq/addRequest`."""
        return list(self._node.get_subscriptions_info_by_topic(topic, True))

    def counts(self, topic: str) -> tuple[int, int]:
        """Number of publishers and subscribers of a topic."""
        return self._node.count_publishers(topic), self._node.count_subscribers(topic)
