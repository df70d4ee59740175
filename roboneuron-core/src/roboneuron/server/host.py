"""Interface of the server to its features: they may read everything and listen to events, but act
only through the same calls as every client.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from roboneuron.contract import check_topic
from roboneuron.errors import ConfigurationError, StateError
from roboneuron.gate import Role, StillReason
from roboneuron.gate.stillness import in_order
from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.moved import Moved
from roboneuron.ros.graph import RosGraph
from roboneuron.server.clock import RobotClock
from roboneuron.supervisor.changes import Event

if TYPE_CHECKING:
    from roboneuron.config import Config
    from roboneuron.gate import AuditLog, AuditRecord
    from roboneuron.modules.settings import ModuleKind
    from roboneuron.plugins.registry import Registry
    from roboneuron.ros.link import RosLink
    from roboneuron.server.feature import Feature, Features
    from roboneuron.server.interception import EndedCall, IncomingCall
    from roboneuron.server.loop import ClosedLoop
    from roboneuron.server.motion_gate import MotionGate
    from roboneuron.server.registry import ToolRegistry
    from roboneuron.server.surface import AnnouncingServer
    from roboneuron.server.tool import CallContext
    from roboneuron.supervisor.health import Health, Modules, ModuleView


F = TypeVar("F")
M = TypeVar("M")
_END_S = 20.0
"""Timeout of an orderly end: ten times the usual duration; an overloaded machine needs up
to 12 s.
"""


class Events:
    """Events of a server. Listeners are added while it is assembled.

    Attributes:
        open: serving begins; the first event, before ROS is joined and features start.
        end: everything is closed; the last event, possibly sent twice, and also without `open`.
        health: the health of a module changed at most 30 ms ago; the module, its previous and its
            present health.
        change: a module started, stopped or ended by itself.
        stop: a stop of a module was requested; the module still runs.
        exposed: the endpoints that agents may use through the gate changed; on the changing thread.
        tools: the listed tools changed; from any thread.
        resource: the content of that URI changed; from any thread.
        fault: a fault that is not a module's health (a lapsed lease, a memory limit); the module, a
            word for the fault, and JSON-serialisable details.
        decision: the gate or the emergency stop of this process wrote an audit record; on the
            requesting thread.
        call_begun: a client called a tool; nothing is done or refused yet.
        call_ended: a tool call was answered, asked its user or was cancelled.
        uncalled: what a tool does was done without a call (a person in a terminal, a time that is
            over): the tool, who or what did it, and JSON-serialisable details; from any thread.
        client: a client of several robots called a tool of one of them (True), or a client has
            disconnected (False).
        presence: a client has opened (1) or closed (-1) a request or a stream.
    """

    call = Moved("Events.call_ended")

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
        self.call_begun: Event[[IncomingCall]] = Event()
        self.call_ended: Event[[EndedCall]] = Event()
        self.uncalled: Event[[str, str, Mapping[str, Any]]] = Event()
        self.client: Event[[str, bool]] = Event()
        self.presence: Event[[str, int]] = Event()


@dataclass(frozen=True, kw_only=True)
class Host:
    """The server as seen by a feature. Usable from any thread unless a member says otherwise.

    Features cannot publish with it: every command that moves a robot passes `gate` or the closed
    loop, as for every other caller.

    Attributes:
        loop: the closed loop: start, steer and stop modules; read their reports.
        audit: the audit log.
        server: the MCP server that every transport serves.
        features: all features of this server.
        tools: all tools by name, for features that add or remove tools at run time.
        events: events of the server, for listeners.
        started_s: monotonic time of the server's start [s].
        state_directory: for files that outlive the server.
        end_motion: ends every motion and the policy, for the given reason, when the robot is
            unattended; returns after at most the given number of seconds.
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
        """The configuration with the running robot, or the configured one."""
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
        """The gate, which checks and sends every command outside the closed loop; it gives no
        access to publishers.

        One installed feature provides it (`Feature.gate`); name that feature in `needs`.

        Raises:
            StateError: no feature provides it, so nothing can be sent for an agent.
            ConfigurationError: two features provide one.
        """
        gates = {
            name: gate
            for name, feature in self.features.loaded.items()
            if (gate := feature.gate) is not None
        }
        if not gates:
            raise StateError(
                "No feature sends messages for others here.",
                hint="The plugin 'rn-direct-path' does; remove it from disabled_plugins.",
            )
        if len(gates) > 1:
            raise ConfigurationError(
                f"The features {' and '.join(map(repr, sorted(gates)))} each offer a gate; a "
                "server has one.",
                hint="Name the plugin of one of them in disabled_plugins.",
            )
        return next(iter(gates.values()))

    @property
    def is_moving(self) -> bool:
        """True if a policy runs, or a call moves something."""
        is_policy = self.modules.view("inference").phase != "stopped"
        return (
            is_policy
            or self.loop.starts.claims.is_moving
            or any(feature.is_moving for feature in self.features.loaded.values())
        )

    @property
    def motions(self) -> tuple[str, ...]:
        """What moves a robot now, a phrase each; a policy does while it has an instruction."""
        found = [one for feature in self.features.loaded.values() for one in feature.motions]
        return (*self.loop.starts.claims.motions, *found)

    def clock(self, namespace: str) -> RobotClock:
        """Time of the robot in that namespace, as its tools follow it: the real one, unless a
        feature gives another one.

        Raises:
            ConfigurationError: two features give one.
        """
        clocks = {
            name: clock
            for name, feature in self.features.loaded.items()
            if (clock := feature.clock(namespace)) is not None
        }
        if len(clocks) > 1:
            raise ConfigurationError(
                f"The features {' and '.join(map(repr, sorted(clocks)))} each give a clock for "
                f"{namespace!r}; a robot has one.",
                hint="Name the plugin of one of them in disabled_plugins.",
            )
        return next(iter(clocks.values()), RobotClock())

    def why_still(self, asker: CallContext | None = None) -> tuple[StillReason, ...]:
        """Why the robot does not move, in the order in which to remove the reasons; empty if it
        would move when asked to. Does not block; from any thread.

        Args:
            asker: the client that would move it; None for the reasons that hold for every client.
        """
        loop, motions = self.loop, self.motions
        # a policy needs every module; a tool only the robot
        needed = MODULE_KINDS if loop.starts.instruction else ("robot",)
        reasons = [
            loop.emergency_stop.still_reason(),
            self.audit.failure,
            *self.modules.still_reasons(needed),
            self._hold() if motions else None,
            loop.starts.still_reason(),
            *loop.starts.claims.still_reasons(),
            *self.features.still_reasons(asker),
            None if asker is None else Role.OPERATOR.still_reason(asker.who, asker.role),
        ]
        return in_order(reasons)

    def _hold(self) -> StillReason | None:
        """Why control holds the arm although something moves it; None if it does not."""
        view = self.modules.view("control")
        if view.phase != "running" or view.report is None:
            return None
        code, reason = view.report.held
        if not code:
            return None
        return StillReason(
            rank="hold",
            rule=code,
            message=f"Control holds the arm: {reason}",
            hint="It follows the next command that is within the limits.",
        )

    @property
    def identifies_clients(self) -> bool:
        """True if a feature distinguishes clients by a secret such as a token."""
        return any(feature.identifies_clients for feature in self.features.loaded.values())

    @property
    def graph(self) -> RosGraph:
        """Discovered ROS graph of the server's node. Raises RoboNeuronError if ROS cannot be
        joined.
        """
        return RosGraph(self._link().node)

    def link(self, sender: Feature[Any]) -> RosLink:
        """Return the server's ROS node to the feature that provides `gate`; joining may take a
        second.

        Raises:
            StateError: `sender` provides no gate.
        """
        if sender.gate is None:
            raise StateError("Only the feature that lends the gate sends; others use `Host.gate`.")
        return self._link()

    @staticmethod
    def end_soon() -> None:
        """Make the kernel end this process after a delay, even if it hangs; its modules notice and
        exit. A transport calls it when its only client has disconnected.

        The default action of SIGALRM needs no thread of this process. Callable from any thread.
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
        """Call `callback` with each message of a topic, on the thread of the ROS node; it must
        return quickly.

        The subscription's reliability matches that of the publishers; images and point clouds are
        received as best effort, see `ros.qos.large_qos`.

        Args:
            message_type: an ordinary rosidl class.
            topic: under the robot's namespace, or absolute.
            callback: called with each message.
            depth: length of the message queue; only the newest is kept by default.
            latched: also receive the last message sent before, if all publishers keep it.

        Returns:
            A function that ends the subscription.

        Raises:
            InvalidInputError: not a valid topic name.
            RoboNeuronError: ROS cannot be joined.
        """
        check_topic(topic)
        # first: two threads must not import rclpy at the same time
        link = self._link()
        place = topic if topic.startswith("/") else f"/{self.config.namespace}/{topic}"
        return link.follow(message_type, place, callback, depth, latched=latched)

    def feature(self, name: str, kind: type[F]) -> F:
        """Return another feature that this one `needs`, of the class `kind`.

        Raises:
            StateError: it is missing, or of another class.
        """
        found = self.features.loaded.get(name)
        if not isinstance(found, kind):
            raise StateError(
                f"There is no feature {name!r} here.", hint="Name it in `needs` of the descriptor."
            )
        return found
