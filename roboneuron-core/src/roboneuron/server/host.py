"""What a server lends its features: reading everything, hearing of what happens, and acting only
through what every caller passes.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from roboneuron.contract import check_topic
from roboneuron.errors import ConfigurationError, StateError
from roboneuron.plugins.availability import install_command, package_of
from roboneuron.ros.graph import RosGraph
from roboneuron.supervisor.changes import Event

if TYPE_CHECKING:
    from roboneuron.config import Config
    from roboneuron.gate import AuditLog, AuditRecord
    from roboneuron.modules.settings import ModuleKind
    from roboneuron.plugins.registry import Registry
    from roboneuron.ros.link import RosLink
    from roboneuron.server.feature import Feature, Features
    from roboneuron.server.loop import ClosedLoop
    from roboneuron.server.motion_gate import MotionGate
    from roboneuron.server.registry import ToolRegistry
    from roboneuron.server.surface import AnnouncingServer
    from roboneuron.supervisor.health import Health, Modules, ModuleView


F = TypeVar("F")
M = TypeVar("M")
_END_S = 20.0
"""Ten times what an end takes; a machine that is overloaded needs up to 12 s."""


class Events:
    """What happens in a server. Listeners are added while it is put together.

    Attributes:
        open: serving begins; told first of all, before ROS is joined and features start.
        end: everything is closed; told last of all, possibly twice, and without `open`.
        health: the health of a module changed at most 30 ms ago; the module, how it was, and how it
            is.
        change: a module started, stopped or ended by itself.
        stop: somebody asked to stop a module, which still runs.
        exposed: what agents may use through the gate changed; on the changing thread.
        tools: the listed tools changed; from any thread.
        resource: the content of that URI changed; from any thread.
        fault: a fault that is no module's health (a lapsed lease, a memory limit); the module, a
            word for the fault, and facts that JSON can hold.
        decision: the gate or the emergency stop of this process wrote a record; on the thread that
            asked.
        call: a tool was called and answered; its name, the arguments as sent, the client, the code
            of the error (empty when it succeeded), and how long it took [s].
        client: a client of several robots made a call of one of them (True), or a client has left
            (False).
        presence: a client has opened (1) or closed (-1) a request or a stream.
    """

    def __init__(self) -> None:
        self.open: Event[[]] = Event()
        self.end: Event[[]] = Event()
        self.health: Event[[ModuleView, Health, Health]] = Event()
        self.change: Event[[ModuleKind]] = Event()
        self.stop: Event[[ModuleKind]] = Event()
        self.exposed: Event[[]] = Event()
        self.tools: Event[[]] = Event()
        self.resource: Event[[str]] = Event()
        self.fault: Event[[str, str, Mapping[str, Any]]] = Event()
        self.decision: Event[[AuditRecord]] = Event()
        self.call: Event[[str, Mapping[str, Any], str, str, float]] = Event()
        self.client: Event[[str, bool]] = Event()
        self.presence: Event[[str, int]] = Event()


@dataclass(frozen=True, kw_only=True)
class Host:
    """The server, as a feature may use it. Usable from any thread unless a member says otherwise.

    Nothing here publishes: what moves a robot goes through `gate`, or through the closed loop, as
    for every caller.

    Attributes:
        loop: the closed loop: start, steer and stop modules; read what they report.
        audit: the audit log.
        server: the MCP server that every transport serves.
        features: all features of this server.
        tools: all tools by name, for features that add or remove some while the server runs.
        events: what happens, for listeners.
        started_s: monotonic time of the server's start [s].
        state_directory: for files that outlive the server.
        end_motion: ends every motion, and the policy, for a reason: nobody looks after the robot
            any more; returns after at most so many seconds.
        wire: descriptors of the standard input and output that the process was started with, for a
            transport over them; in `roboneuron serve` 0 and 1 are others, see `cli/serve.py`.
    """

    loop: ClosedLoop
    audit: AuditLog
    server: AnnouncingServer
    features: Features
    tools: ToolRegistry
    events: Events
    started_s: float
    state_directory: Path
    end_motion: Callable[[str, float], None]
    _link: Callable[[], RosLink]
    wire: tuple[int, int] = (0, 1)

    @property
    def config(self) -> Config:
        """The configuration with the robot that is running, or the configured one."""
        return self.loop.config

    @property
    def modules(self) -> Modules:
        """The processes of the modules; `loop` starts and stops them."""
        return self.loop.modules

    @property
    def registry(self) -> Registry:
        """The installed plugins."""
        return self.loop.registry

    @property
    def gate(self) -> MotionGate:
        """In front of everything that moves a robot beside the closed loop: sends what it allows,
        lends no publisher.

        One installed feature lends it (`Feature.gate`); name that feature in `needs`.

        Raises:
            StateError: none does: nothing can be sent for an agent.
            ConfigurationError: two do.
        """
        gates = {
            name: gate
            for name, feature in self.features.loaded.items()
            if (gate := feature.gate) is not None
        }
        if not gates:
            package = package_of("feature", "direct-path")
            hint = (
                "The feature 'direct-path' does. If it is not installed: "
                f"{install_command(package or '')}."
            )
            raise StateError("No feature sends messages for others here.", hint=hint)
        if len(gates) > 1:
            raise ConfigurationError(
                f"The features {' and '.join(map(repr, sorted(gates)))} each offer a gate; a "
                "server has one.",
                hint="Name the plugin of one of them in disabled_plugins.",
            )
        return next(iter(gates.values()))

    @property
    def is_moving(self) -> bool:
        """Whether a policy runs, or a call moves something."""
        is_policy = self.modules.view("inference").phase != "stopped"
        return is_policy or any(feature.is_moving for feature in self.features.loaded.values())

    @property
    def identifies_clients(self) -> bool:
        """Whether a feature tells clients apart by what they alone know, such as a token."""
        return any(feature.identifies_clients for feature in self.features.loaded.values())

    @property
    def graph(self) -> RosGraph:
        """What the server's node has discovered of the ROS graph. Raises RoboNeuronError when ROS
        cannot be joined.
        """
        return RosGraph(self._link().node)

    def link(self, sender: Feature[Any]) -> RosLink:
        """The server's ROS node, for the feature that lends `gate`; it may take a second to join.

        Raises:
            StateError: `sender` lends none.
        """
        if sender.gate is None:
            raise StateError("Only the feature that lends the gate sends; others use `Host.gate`.")
        return self._link()

    @staticmethod
    def end_soon() -> None:
        """The kernel ends this process in a while, whatever hangs in it; its modules hear of that
        and leave. A transport calls it when its only client has left.

        The default action of SIGALRM needs nobody's help. Callable from any thread.
        """
        signal.setitimer(signal.ITIMER_REAL, _END_S)

    def subscribe(
        self,
        message_type: type[M],
        topic: str,
        callback: Callable[[M], None],
        *,
        depth: int = 1,
        latched: bool = False,
    ) -> Callable[[], None]:
        """Call `callback` with each message of a topic, from the thread of the ROS node; it must
        return quickly.

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
            InvalidInputError: this can be no topic.
            RoboNeuronError: ROS cannot be joined.
        """
        check_topic(topic)
        # first: two threads must not import rclpy at the same time
        link = self._link()
        place = topic if topic.startswith("/") else f"/{self.config.namespace}/{topic}"
        return link.follow(message_type, place, callback, depth, latched=latched)

    def feature(self, name: str, kind: type[F]) -> F:
        """Another feature that this one `needs`, of the class `kind`.

        Raises:
            StateError: there is none, or it is of another class.
        """
        found = self.features.loaded.get(name)
        if not isinstance(found, kind):
            raise StateError(
                f"There is no feature {name!r} here.", hint="Name it in `needs` of the descriptor."
            )
        return found
