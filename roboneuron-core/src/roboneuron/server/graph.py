"""What the ROS graph shows now, for features."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink


class RosGraph:
    """Names, types and counts, as far as this process has discovered; every method raises as `Supervisor.link`."""

    def __init__(self, link: Callable[[], RosLink]) -> None:
        self._link = link

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""
        node = self._link().node  # first: two threads must not import rclpy at the same time
        from roboneuron.ros.live import topic_types  # heavy

        return topic_types(node)

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""
        node = self._link().node
        from roboneuron.ros.live import service_types  # heavy

        return service_types(node)

    def actions(self) -> dict[str, list[str]]:
        """Types by absolute action name."""
        node = self._link().node
        from roboneuron.ros.live import action_types  # heavy

        return action_types(node)

    def nodes(self) -> list[str]:
        """Absolute names of all nodes."""
        node = self._link().node
        from roboneuron.ros.live import node_names  # heavy

        return node_names(node)

    def used(self) -> dict[str, dict[str, str]]:
        """Type by absolute name for each kind of use; see `roboneuron.ros.live.used_names`."""
        node = self._link().node
        from roboneuron.ros.live import used_names  # heavy

        return used_names(node)

    def counts(self, topic: str) -> tuple[int, int]:
        """Publishers and subscribers of a topic."""
        node = self._link().node
        return node.count_publishers(topic), node.count_subscribers(topic)
