"""Present content of the ROS graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from roboneuron.direct_path.peers import problems_of
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint

_FEEDBACK = "/_action/feedback"
"""Every action has this topic. Source: rcl_action/src/rcl_action/graph.c."""


class GraphNames:
    """Names, types and counts discovered by the server's node; every method raises as
    `Host.graph`.
    """

    def __init__(self, host: Host) -> None:
        self._host = host

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        return self._host.graph.topics()

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        return self._host.graph.services()

    def actions(self) -> dict[str, list[str]]:
        """Types by absolute action name."""
        return {
            name.removesuffix(_FEEDBACK): [kind.removesuffix("_FeedbackMessage") for kind in kinds]
            for name, kinds in self.topics().items()
            if name.endswith(_FEEDBACK)
        }

    def nodes(self) -> list[str]:
        """Absolute names of all nodes, without duplicates: ROS allows several nodes of one name,
        and lists dead ones for a while.
        """
        found = self._host.graph.nodes()
        return sorted({f"{space.rstrip('/')}/{name}" for name, space in found})

    def used(self) -> dict[str, dict[str, str]]:
        """Type by absolute name for each kind of use: "publish" for topics that others subscribe
        to, "read" for those they publish, ...

        Names with several types are left out.
        """
        graph = self._host.graph
        own = graph.node_name
        topics = _with_one_type(self.topics())
        return {
            "publish": {n: t for n, t in topics.items() if _others(graph.subscriptions(n), own)},
            "read": {n: t for n, t in topics.items() if _others(graph.publishers(n), own)},
            "service": _with_one_type(self.services()),
            "action": _with_one_type(self.actions()),
        }

    def problems(self, exposed: ExposedEndpoint) -> list[str]:
        """Problems of an exposed endpoint with all or some peers; a sentence each."""
        endpoint, graph = exposed.endpoint, self._host.graph
        return problems_of(endpoint.kind, exposed.topic, endpoint.type, graph)

    def counts(self, topic: str) -> tuple[int, int]:
        """Number of publishers and subscribers of a topic."""
        return self._host.graph.counts(topic)


def _with_one_type(types: dict[str, list[str]]) -> dict[str, str]:
    return {name: found[0] for name, found in types.items() if len(found) == 1}


class _OfNode(Protocol):
    """A publisher or subscription of the graph."""

    node_name: str


def _others(infos: Sequence[_OfNode], own: str) -> bool:
    """True if there is another node than this server's, which is called `own`."""
    return any(info.node_name != own for info in infos)
