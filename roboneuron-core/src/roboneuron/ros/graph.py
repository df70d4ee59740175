"""What the ROS graph shows now, for features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rclpy.node import Node


class RosGraph:
    """Names, types and counts, as far as the server's node has discovered; every method raises as `Supervisor.link`."""

    def __init__(self, node: Callable[[], Node]) -> None:
        """Args:
        node: the server's.
        """
        self._node = node

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        return dict(self._node().get_topic_names_and_types())

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        return dict(self._node().get_service_names_and_types())

    def actions(self) -> dict[str, list[str]]:
        """Types by absolute action name."""
        node = self._node()  # first: two threads must not import rclpy at the same time
        from rclpy.action.graph import get_action_names_and_types  # heavy

        return dict(get_action_names_and_types(node))

    def nodes(self) -> list[str]:
        """Absolute names of all nodes, each once: ROS lets several nodes, and for a while dead ones, share a name."""
        found = self._node().get_node_names_and_namespaces()
        return sorted({f"{space.rstrip('/')}/{name}" for name, space in found})

    def used(self) -> dict[str, dict[str, str]]:
        """Type by absolute name for each kind of use: "publish" where others subscribe, "read" where they publish, ...

        Names that carry several types are left out.
        """
        node = self._node()
        topics = _with_one_type(self.topics())
        return {
            "publish": {n: t for n, t in topics.items() if _others(node.get_subscriptions_info_by_topic(n), node)},
            "read": {n: t for n, t in topics.items() if _others(node.get_publishers_info_by_topic(n), node)},
            "service": _with_one_type(self.services()),
            "action": _with_one_type(self.actions()),
        }

    def counts(self, topic: str) -> tuple[int, int]:
        """Publishers and subscribers of a topic."""
        node = self._node()
        return node.count_publishers(topic), node.count_subscribers(topic)

    def publisher_types(self, topic: str) -> list[str]:
        """Message types that are published on an absolute topic, one for each publisher."""
        return [str(info.topic_type) for info in self._node().get_publishers_info_by_topic(topic)]


def _with_one_type(types: dict[str, list[str]]) -> dict[str, str]:
    return {name: found[0] for name, found in types.items() if len(found) == 1}


def _others(infos: Sequence[Any], node: Node) -> bool:
    """Whether somebody else than this node is there."""
    return any(info.node_name != node.get_name() for info in infos)
