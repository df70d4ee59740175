"""What a server lends its features: reading everything, and acting only through what every caller passes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from roboneuron.errors import StateError

if TYPE_CHECKING:
    from mcp.server import Server

    from roboneuron.config import Config
    from roboneuron.gate import AuditLog
    from roboneuron.plugins.registry import Registry
    from roboneuron.server.app import Application
    from roboneuron.server.events import Events
    from roboneuron.server.loop import ClosedLoop
    from roboneuron.server.motion.gate import MotionGate
    from roboneuron.server.registry import ToolRegistry
    from roboneuron.supervisor.supervisor import Supervisor


class GraphNode(Protocol):
    """The part of `rclpy.node.Node` that tells of the ROS graph; `info` is an `rclpy` TopicEndpointInfo."""

    def get_name(self) -> str: ...
    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]: ...
    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]: ...
    def get_service_names_and_types(self) -> list[tuple[str, list[str]]]: ...
    def get_publishers_info_by_topic(self, topic_name: str) -> list[Any]: ...
    def get_subscriptions_info_by_topic(self, topic_name: str) -> list[Any]: ...
    def count_publishers(self, topic_name: str) -> int: ...
    def count_subscribers(self, topic_name: str) -> int: ...


F = TypeVar("F")
M = TypeVar("M")


class Host:
    """The server, as a feature may use it. Usable from any thread unless a member says otherwise.

    Nothing here publishes: what moves a robot goes through `gate`, or through the closed loop, as for every caller.
    """

    def __init__(self, application: Application) -> None:
        self._application = application

    @property
    def config(self) -> Config:
        """The configuration with the robot that is running, or the configured one."""
        return self._application.loop.config

    @property
    def registry(self) -> Registry:
        """The installed plugins."""
        return self._application.plugins.current()

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop: start, steer and stop modules; read what they report."""
        return self._application.loop

    @property
    def supervisor(self) -> Supervisor:
        """The processes of the modules."""
        return self._application.supervisor

    @property
    def gate(self) -> MotionGate:
        """The gate in front of everything that moves a robot: sends what it allows, and lends no publisher."""
        return self._application.direct.lent

    @property
    def audit(self) -> AuditLog:
        """The audit log."""
        return self._application.loop.emergency_stop.audit

    @property
    def server(self) -> Server[Any]:
        """The MCP server that every transport serves."""
        return self._application.server

    @property
    def identifies_clients(self) -> bool:
        """Whether a feature tells clients apart by what they alone know, such as a token."""
        return self._application.features.identifies_clients

    @property
    def tools(self) -> ToolRegistry:
        """All tools by name, for features that add or remove some while the server runs."""
        return self._application.tools

    @property
    def events(self) -> Events:
        """What happens, for listeners."""
        return self._application.events

    @property
    def state_directory(self) -> Path:
        """Where files that outlive the server are kept."""
        return self._application.supervisor.state_directory

    @property
    def started_s(self) -> float:
        """Monotonic time of the server's start [s]."""
        return self._application.started_s

    @property
    def graph(self) -> GraphNode:
        """What the server's node has discovered of the ROS graph. Raises RoboNeuronError when ROS cannot be joined."""
        node: GraphNode = self.supervisor.link.node
        return node

    def subscribe(
        self, message_type: type[M], topic: str, callback: Callable[[M], None], *, depth: int = 1, latched: bool = False
    ) -> Callable[[], None]:
        """Call `callback` with each message of a topic, from the thread of the ROS node; it must return quickly.

        The subscription is as reliable as those are who publish the topic now.

        Args:
            message_type: an ordinary rosidl class.
            topic: under the robot's namespace, or absolute.
            callback: called with each message.
            depth: how many messages wait for it; only the newest is kept by default.
            latched: also take the last message that came before, where all publishers keep it.

        Returns:
            What ends it.

        Raises:
            RoboNeuronError: ROS cannot be joined.
        """
        link = self.supervisor.link  # first: two threads must not import rclpy at the same time
        from roboneuron.ros.qos import requested_qos  # heavy

        place = topic if topic.startswith("/") else f"/{self.config.namespace}/{topic}"
        qos = requested_qos(link.node.get_publishers_info_by_topic(place), depth, latched=latched)
        return link.subscribe(message_type, place, callback, qos)

    def resource_updated(self, uri: str) -> None:
        """Tell clients that subscribed to a resource that it changed."""
        self._application.notices.resource_updated(uri)

    def end_motion(self, reason: str, timeout_s: float = 2.0) -> None:
        """End every motion, and the policy: nobody looks after the robot any more."""
        self._application.end_motion(reason, timeout_s)

    def feature(self, name: str, kind: type[F]) -> F:
        """Another feature that this one `needs`, of the class `kind`.

        Raises:
            StateError: there is none, or it is of another class.
        """
        found = self._application.features.get(name)
        if not isinstance(found, kind):
            raise StateError(f"There is no feature {name!r} here.", hint="Name it in `needs` of the descriptor.")
        return found
