"""What a module process lends to its module and to features."""

from __future__ import annotations

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

from roboneuron.config import ModuleSettings
from roboneuron.contract import Hold, JointCommand, Pose
from roboneuron.errors import UnsafeError
from roboneuron.modules.settings import NEEDS_NEW_START
from roboneuron.modules.status import StatusWriter
from roboneuron.plugins.discovery import discover
from roboneuron.ros.qos import NEWEST
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_TRAJECTORY

Value = TypeVar("Value", str, int)
"""Of a ROS parameter."""
_TO_JOINTS = {JOINT_TRAJECTORY, JOINT_COMMAND}


class Handover:
    """What stands between a module and its topics while it replaces another module or is replaced:
    what it asks about its inputs and tells of its outputs. The answers here are those of a module
    that nobody replaces.

    A feature puts its own into the module's process (`ModuleHost.handover`). Inputs are told apart
    by their time stamps [ROS time, ns]: capture times of images, times at which actions were sent
    and joints measured. Methods are called from any of the module's threads.
    """

    def is_shadow(self, stamp_ns: int) -> bool:
        """Whether that input is still the predecessor's: work on it, and send nothing."""
        return False

    def is_over(self, stamp_ns: int) -> bool:
        """Whether that input is already the successor's."""
        return False

    def is_ours(self, stamp_ns: int) -> bool:
        """Whether this module is to act on that input."""
        return not self.is_shadow(stamp_ns) and not self.is_over(stamp_ns)

    def may_send(self, now_ns: int) -> bool:
        """Whether the predecessor has finished, so that this module may send its own."""
        return True

    def must_fall_silent(self, now_ns: int) -> bool:
        """Whether the successor replaces what is left of a chunk."""
        return False

    def withhold(self, output: JointCommand | Hold | Pose) -> None:
        """What the module would have sent for an input of the predecessor."""

    def note_sent(self, what: str) -> None:
        """An output of that name has gone out."""


class ModuleHost(LifecycleNode):  # type: ignore[misc]
    """The node of a module process, as far as its module and features use it.

    Features (`FeatureSpec.on_join`) use the settings, the status, what a module asks on its way,
    parameters and stops; modules also publish and subscribe. Attributes are set by the function of
    a feature, before the module is made, on the executor's thread.

    Attributes:
        settings: of the process.
        status: where to report.
        module: from `configure` to cleanup, else None.
        resources: what is released at cleanup, from `configure` on.
        outputs: by topic that `advertise` has made, what counts its subscriptions; the publisher
            itself belongs to who has made it.
        stopped: whether the emergency stop is latched.
        stops: stops seen so far.
        needs_start: which of them forbids motion until somebody asks for it anew; empty when none
            does.
        handover: which inputs are this module's; a feature that replaces modules puts its own
            object here.
        lent: what features lend the module, under names that the module's package publishes.
        on_configured: called with the module at the end of every `configure`, which fails if one
            raises.
    """

    def __init__(self, settings: ModuleSettings) -> None:
        """Args:
        settings: of the process; their namespace and node name are the node's.
        """
        super().__init__(settings.node_name, namespace=settings.config.namespace)
        self.settings = settings
        self.status = StatusWriter(settings.status_name)
        self.module: Module | None = None
        self.resources = ExitStack()
        self.outputs: dict[str, Callable[[], int]] = {}
        self.stopped = False
        self.stops, self.needs_start = 0, ""
        self.handover = Handover()
        self.lent: dict[str, object] = {}
        self.on_configured: list[Callable[[Module], None]] = []

    @abstractmethod
    def is_server_silent(self) -> bool:
        """Whether the server gave no sign of life for the shorter one of the times that robot and
        control allow; never for a module that was started without one.

        A silence that has just ended goes on until the executor has looked at it: when this process
        itself was frozen, the thread that reads the signs of life may be the first to go on.
        """

    def create_timer(self, period_s: float, callback: Callable[[], None], **options: Any) -> Any:
        """As of Node, by the steady clock: a timer by ROS time stands still for an hour when the
        clock is set back by an hour.

        Args:
            period_s: [s].
            callback: called on the executor's thread.
            options: of Node; another `clock` is kept.
        """
        return super().create_timer(
            period_s, callback, **{"clock": Clock(clock_type=ClockType.STEADY_TIME)} | options
        )

    def now_ns(self) -> int:
        """ROS time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def advertise(self, message_type: type, topic: str) -> LifecyclePublisher:
        """A publisher until cleanup, one of `outputs`; it sends while the node is active.

        Args:
            message_type: an ordinary rosidl class.
            topic: under the robot's namespace.

        Raises:
            UnsafeError: it leads to the joints, which `HoldingModule` alone commands.
        """
        if topic in _TO_JOINTS and not _TO_JOINTS.isdisjoint(self.outputs):
            raise UnsafeError(
                f"{topic!r} would be a second path to the joints, beside the limits.",
                hint="Ask for motion by `HoldingModule.act`.",
            )
        publisher = self.create_lifecycle_publisher(message_type, topic, NEWEST)
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
            callback: takes the message, and its info where it has a second argument.
            qos: only the newest message is kept by default.
            group: says who calls; None for the executor.
        """
        subscription = self.create_subscription(
            message_type, topic, callback, qos, callback_group=group
        )
        self.resources.callback(self.destroy_subscription, subscription)

    def repeat(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call `callback` once a period [s] until cleanup, on the executor's thread."""
        self.resources.callback(self.destroy_timer, self.create_timer(period_s, callback))

    def require_start(self, reason: str, code: str = NEEDS_NEW_START) -> None:
        """A stop has come, such as a recovery: nothing moves before somebody asks for it anew,
        whatever ends the stop; from any thread.

        Perception moves nothing, so that it goes on.

        Args:
            reason: in words, for the status and for whoever asks why nothing moves.
            code: see `Module.stop`.
        """
        if self.settings.kind == "perception":
            return
        self.needs_start = reason
        self.stops += 1
        self.status.announce(needs_start=reason, stops=self.stops)
        if self.module is not None:
            self.module.stop(code)

    def add_parameter(
        self,
        name: str,
        value: Value,
        take: Callable[[Value], None],
        refuse: Callable[[Value], str] = lambda _: "",
    ) -> Callable[[], None]:
        """Declare a ROS parameter, which only the server of this module can set; call what is
        returned to remove it.

        Args:
            name: of the parameter.
            value: the first one; ROS refuses values of other types.
            take: called with each later value, on the executor's thread.
            refuse: says what is wrong with a value; empty for nothing.
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

    The constructor acquires: it loads weights, opens the device, creates publishers and
    subscriptions. What it acquires it gives to `node.resources`, which releases it, the newest
    first, also when the constructor fails.

    Any method may raise RoboNeuronError: the transition fails, the reason goes to /diagnostics.
    """

    def __init__(self, node: ModuleHost) -> None:
        """Args:
        node: lends everything; kept as `node`, its parts under their own names.
        """
        self.node = node
        self.config = node.settings.config
        self.status = node.status
        self.handover = node.handover
        self.registry = discover(self.config.disabled_plugins)

    @abstractmethod
    def activate(self) -> None:
        """Let data out."""

    @abstractmethod
    def deactivate(self) -> None:
        """Silence; also called before `activate`."""

    def emergency_stop(self, latched: bool) -> None:  # noqa: B027
        """The latch changed; called after `stop` where it was set."""

    def why_stopped(self) -> str:
        """Word for the stop that forbids every motion now; empty when none does."""
        if self.node.stopped:
            return "emergency_stop"
        # nobody could stop the robot from outside: the server is frozen
        if self.node.is_server_silent():
            return "server_silent"
        return NEEDS_NEW_START if self.node.needs_start else ""

    def stop(self, code: str) -> None:  # noqa: B027
        """A stop has come: what was asked for before it is not carried out any more.

        Args:
            code: "emergency_stop" or "server_silent", with which the robot is to hold;
                `NEEDS_NEW_START` after what has stopped it by itself.
        """
