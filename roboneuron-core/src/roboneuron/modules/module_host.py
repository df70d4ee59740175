"""Interface of a module process to its module and to features."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from roboneuron import foreign
from roboneuron.config import LimitsConfig, ModuleSettings
from roboneuron.errors import ConfigurationError, ForeignDataError, UnsafeError
from roboneuron.modules.settings import (
    ARM_KINDS,
    LIMITS_PARAMETER,
    NEEDS_NEW_START,
    STOP_MOTION,
)
from roboneuron.modules.status import StatusWriter
from roboneuron.modules.step_filters import StepFilter, StepFilters
from roboneuron.moved import Moved
from roboneuron.plugins.discovery import discover
from roboneuron.ros.executor import created
from roboneuron.ros.graph import foreign_names
from roboneuron.ros.qos import NEWEST
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_TRAJECTORY

Value = TypeVar("Value", str, int)
"""Type of a ROS parameter."""
_TO_JOINTS = {JOINT_TRAJECTORY, JOINT_COMMAND}


class ModuleHost(LifecycleNode):  # type: ignore[misc]
    """Node of a module process, as used by its module and by features.

    Features (`FeatureSpec.on_join`) use the settings, the status, parameters, stops and the list
    of filters; modules also publish and subscribe. A feature's function is called before the module
    is created, on the executor's thread.

    Attributes:
        settings: settings of the process.
        status: status writer of the process.
        module: from `configure` to cleanup, else None.
        resources: released at cleanup; from `configure` on.
        outputs: subscription counters by topic, for topics made by `advertise`; the publisher
            itself belongs to the caller.
        stopped: the emergency stop is latched.
        stops: number of stops seen.
        needs_start: reason that forbids motion until it is requested anew; empty for none.
        stops_lock: guards these two.
        filters: of features; those that need the module are added to `Module.filters`.
        on_configured: called with the module at the end of every `configure`, which fails if one
            raises.
    """

    lent, provide = Moved("ModuleHost.filters"), Moved("ModuleHost.filters")
    handover = Moved("ModuleHost.filters")

    def __init__(self, settings: ModuleSettings) -> None:
        """Args:
        settings: settings of the process, with the node's namespace and name.
        """
        super().__init__(settings.node_name, namespace=settings.config.namespace)
        self.settings = settings
        self.status = StatusWriter(settings.status_name)
        self.module: Module | None = None
        self.resources = ExitStack()
        self.outputs: dict[str, Callable[[], int]] = {}
        self.stopped = False
        self.stops, self.needs_start = 0, ""
        # a stop and a permission may come on two threads
        self.stops_lock = threading.Lock()
        self.filters: list[StepFilter] = []
        self.on_configured: list[Callable[[Module], None]] = []

    @abstractmethod
    def is_server_silent(self) -> bool:
        """True if no sign of life of the server came for `Config.silence_s`, or this process has
        just been resumed (SIGCONT); without a server, only the latter.

        A silence that has just ended lasts until the executor has handled it: after this process
        was frozen, the thread that reads the signs of life may resume first.
        """

    def create_timer(self, period_s: float, callback: Callable[[], None], **options: Any) -> Any:
        """Create a timer as Node does, but on the steady clock: a timer on ROS time would stop for
        an hour when the clock is set back by an hour.

        Args:
            period_s: [s].
            callback: called on the executor's thread.
            options: options of Node; an explicit `clock` is kept.
        """
        return super().create_timer(
            period_s, callback, **{"clock": Clock(clock_type=ClockType.STEADY_TIME)} | options
        )

    def now_ns(self) -> int:
        """ROS time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def advertise(self, message_type: type, topic: str) -> LifecyclePublisher:
        """Create a publisher that lives until cleanup, counted in `outputs`; it sends while the
        node is active.

        Args:
            message_type: an ordinary rosidl class.
            topic: under the robot's namespace.

        Raises:
            UnsafeError: the topic leads to the joints, which only `HoldingModule` commands.
            ConfigurationError: as `roboneuron.ros.executor.created`.
        """
        if topic in _TO_JOINTS and not _TO_JOINTS.isdisjoint(self.outputs):
            raise UnsafeError(
                f"{topic!r} would be a second path to the joints, beside the limits.",
                hint="Ask for motion by `HoldingModule.act`.",
            )
        publisher = created(
            self,
            "publisher",
            topic,
            message_type,
            lambda: self.create_lifecycle_publisher(message_type, topic, NEWEST),
        )
        self.outputs[topic] = publisher.get_subscription_count
        self.resources.callback(self.destroy_lifecycle_publisher, publisher)
        self.resources.callback(self.outputs.pop, topic)
        return publisher

    def subscribe(
        self,
        message_type: type,
        topic: str,
        callback: Callable[..., None],
        qos: QoSProfile = NEWEST,
        group: CallbackGroup | None = None,
    ) -> None:
        """Call `callback` with each message until cleanup, on the executor's thread.

        Args:
            message_type: an ordinary rosidl class.
            topic: under the robot's namespace.
            callback: takes the message, and its info if it has a second argument.
            qos: only the newest message is kept by default.
            group: callback group that calls it; None for the executor's.

        Raises:
            ConfigurationError: as `roboneuron.ros.executor.created`.
        """
        subscription = created(
            self,
            "subscription",
            topic,
            message_type,
            lambda: self.create_subscription(
                message_type, topic, callback, qos, callback_group=group
            ),
        )
        self.resources.callback(self.destroy_subscription, subscription)

    def senders(self, topic: str) -> str:
        """Names of the foreign nodes that publish on a topic, for messages to a person.

        Args:
            topic: under the robot's namespace.

        Returns:
            "/a or /b"; empty if only the server and control do, or no name is known.
        """
        found = self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
        space = self.get_namespace().rstrip("/")
        # a successor of control is called so while both run
        own = (f"{space}/control", f"{space}/control_b")
        return " or ".join(foreign_names(found, own))

    def repeat(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call `callback` every `period_s` [s] until cleanup, on the executor's thread."""
        self.resources.callback(self.destroy_timer, self.create_timer(period_s, callback))

    def require_start(self, reason: str, code: str = NEEDS_NEW_START) -> None:
        """Forbid motion until it is requested anew, for example after a recovery; from any thread.

        Does nothing in perception and in kinds that features add, which move nothing.

        Args:
            reason: text for the status and for refused requests.
            code: see `Module.stop`.
        """
        if self.settings.kind not in (*ARM_KINDS, "inference"):
            return
        with self.stops_lock:
            self.needs_start = reason
            self.stops += 1
            self.status.announce(needs_start=reason, stops=self.stops)
        if self.module is not None:
            self.module.stop(code)

    def stop_motion(self, reason: str) -> None:
        """End motion on a client's request; see `require_start`."""
        self.require_start(reason, STOP_MOTION)

    def add_parameter(
        self,
        name: str,
        value: Value,
        take: Callable[[Value], None],
        refuse: Callable[[Value], str] = lambda _: "",
    ) -> Callable[[], None]:
        """Declare a ROS parameter that only the server of this module can set; the returned
        function removes it.

        Args:
            name: name of the parameter.
            value: the initial value; ROS refuses values of other types.
            take: called with each later value, on the executor's thread.
            refuse: returns what is wrong with a value; empty if nothing.
        """

        def check(parameters: list[Parameter]) -> SetParametersResult:
            reason = next((r for p in parameters if p.name == name and (r := refuse(p.value))), "")
            return SetParametersResult(successful=not reason, reason=reason)

        def take_all(parameters: list[Parameter]) -> None:
            for parameter in parameters:
                if parameter.name == name:
                    take(parameter.value)

        def remove() -> None:
            self.remove_on_set_parameters_callback(check)
            self.remove_post_set_parameters_callback(take_all)
            self.undeclare_parameter(name)

        self.declare_parameter(name, value)
        self.add_on_set_parameters_callback(check)
        self.add_post_set_parameters_callback(take_all)
        return remove


class Module(ABC):
    """Behaviour of one kind of module, from `configure` to cleanup. Methods are called on the
    executor's thread.

    The constructor acquires resources: it loads weights, opens the device, creates publishers and
    subscriptions. It registers them with `node.resources`, which releases them in reverse order,
    also when the constructor fails.

    Any method may raise RoboNeuronError: the transition fails, and the reason goes to /diagnostics.
    """

    def __init__(self, node: ModuleHost) -> None:
        """Args:
        node: kept as `node`; its parts also under their own names, and its filters as the first.
        """
        self.node = node
        self.config = node.settings.config
        self.status = node.status
        self.filters = StepFilters(node.filters)
        self.registry = discover(self.config.disabled_plugins, self.config.robot)

    @abstractmethod
    def activate(self) -> None:
        """Start to publish and to accept inputs."""

    @abstractmethod
    def deactivate(self) -> None:
        """Stop to publish and to accept inputs; also called before `activate`."""

    def emergency_stop(self, latched: bool) -> None:  # noqa: B027
        """Handle a change of the latch; called after `stop` if it was set."""

    def why_stopped(self) -> str:
        """Code of the stop that forbids motion now; empty if none does."""
        if self.node.stopped:
            return "emergency_stop"
        # with a frozen server, the robot could not be stopped from outside
        if self.node.is_server_silent():
            return "server_silent"
        return NEEDS_NEW_START if self.node.needs_start else ""

    def stop(self, code: str) -> None:  # noqa: B027
        """Handle a stop: requests from before it must not be carried out any more.

        Args:
            code: "emergency_stop", "server_silent" or `STOP_MOTION`, with which the robot has to
                hold; `NEEDS_NEW_START` if it has already stopped by itself.
        """


class LimitedModule(Module):
    """A module that applies limits to commands, and takes tighter ones while it runs."""

    @abstractmethod
    def use_limits(self, limits: LimitsConfig) -> None:
        """Apply other limits from the next command on.

        Raises:
            ConfigurationError: see `check_limits`.
        """

    @abstractmethod
    def check_limits(self, limits: LimitsConfig) -> object:
        """Raise ConfigurationError if the limits do not fit the robot, or are wider than the
        configured ones.
        """

    @property
    def limits_at_start(self) -> LimitsConfig:
        """The limits of the process's settings: the configured ones, or tighter ones."""
        return self.node.settings.tightened or self.config.limits

    def offer_limits(self) -> None:
        """Declare the ROS parameter `LIMITS_PARAMETER`, with which the server changes the limits
        until cleanup.
        """
        self._report_limits(is_tightened=self.node.settings.tightened is not None)
        self.node.resources.callback(
            self.node.add_parameter(LIMITS_PARAMETER, "", self._take_limits, self._why_not_limits)
        )

    def _take_limits(self, text: str) -> None:
        self.use_limits(self._parse_limits(text))
        self._report_limits(is_tightened=bool(text))

    def _why_not_limits(self, text: str) -> str:
        try:
            self.check_limits(self._parse_limits(text))
        except ConfigurationError as error:
            return error.message
        return ""

    def _report_limits(self, *, is_tightened: bool) -> None:
        self.status.set_value("limits", "tightened" if is_tightened else "configured")

    def _parse_limits(self, text: str) -> LimitsConfig:
        """Parse limits; empty for the configured ones. Raises ConfigurationError."""
        if not text:
            return self.config.limits
        try:
            return foreign.decode_model(LimitsConfig, text, "the text")
        except ForeignDataError as error:
            raise ConfigurationError(f"The limits are no valid [limits]: {error}") from error
