"""What the ROS graph shows now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from roboneuron import Host
from roboneuron.feature import GraphNode

_FEEDBACK = "/_action/feedback"
"""Every action has this topic. Source: rcl_action/src/rcl_action/graph.c."""


class RosGraph:
    """Names, types and counts, as far as the server's node has discovered; every method raises
    as `Host.graph`.
    """

    def __init__(self, host: Host) -> None:
        self._host = host

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        return dict(self._host.graph.get_topic_names_and_types())

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        return dict(self._host.graph.get_service_names_and_types())

    def actions(self) -> dict[str, list[str]]:
        """Types by absolute action name."""
        found = self._host.graph.get_topic_names_and_types()
        return {
            name.removesuffix(_FEEDBACK): [kind.removesuffix("_FeedbackMessage") for kind in kinds]
            for name, kinds in found
            if name.endswith(_FEEDBACK)
        }

    def nodes(self) -> list[str]:
        """Absolute names of all nodes, each once: ROS lets several nodes, and for a while dead
        ones, share a name.
        """
        found = self._host.graph.get_node_names_and_namespaces()
        return sorted({f"{space.rstrip('/')}/{name}" for name, space in found})

    def used(self) -> dict[str, dict[str, str]]:
        """Type by absolute name for each kind of use: "publish" where others subscribe, "read"
        where they publish, ...

        Names that carry several types are left out.
        """
        node = self._host.graph
        topics = _with_one_type(self.topics())
        return {
            "publish": {
                n: t
                for n, t in topics.items()
                if _others(node.get_subscriptions_info_by_topic(n), node)
            },
            "read": {
                n: t
                for n, t in topics.items()
                if _others(node.get_publishers_info_by_topic(n), node)
            },
            "service": _with_one_type(self.services()),
            "action": _with_one_type(self.actions()),
        }

    def counts(self, topic: str) -> tuple[int, int]:
        """Publishers and subscribers of a topic."""
        node = self._host.graph
        return node.count_publishers(topic), node.count_subscribers(topic)


def _with_one_type(types: dict[str, list[str]]) -> dict[str, str]:
    return {name: found[0] for name, found in types.items() if len(found) == 1}


def _others(infos: Sequence[Any], node: GraphNode) -> bool:
    """Whether somebody else than this node is there."""
    return any(info.node_name != node.get_name() for info in infos)
