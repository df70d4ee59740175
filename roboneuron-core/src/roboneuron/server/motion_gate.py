"""Requests to the gate and its answers: every command outside the closed loop that moves a robot
passes the gate.

The core declares the interface; one installed feature implements it and provides it as `Host.gate`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

from roboneuron.contract import Endpoint, JointSample, RobotProfile
from roboneuron.server.verdict import Sent, Verdict

if TYPE_CHECKING:
    from unique_identifier_msgs.msg import UUID

    from roboneuron.gate.motion.joint_space import JointLimit
    from roboneuron.ros.link import Call
    from roboneuron.server.tool import CallContext


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ExposedEndpoint:
    """An endpoint of one robot that agents may use.

    Attributes:
        robot: name of the robot.
        namespace: its ROS namespace, without a leading slash.
        label: noun for the names of its tools.
        endpoint: the gate's entry; its name is unique among the robot's.
        profile: the robot's profile, None for a robot without a plugin.
        clamp: field paths whose values are moved to the nearest bound instead of refused.
        nonfinite: field paths (without indices) that may hold NaN and infinities.
        require_subscriber: a message without a subscriber is an error.
        moves: it moves the robot, and is refused while a policy does.
        hidden: it has no tools; another tool uses it.
        control_input: "action" or "lead" (a person's rows) if control follows it, or empty.
        topic: absolute name of the topic, service or action.
    """

    robot: str
    namespace: str
    label: str
    endpoint: Endpoint
    profile: RobotProfile | None = None
    clamp: frozenset[str] = frozenset()
    nonfinite: frozenset[str] = frozenset()
    require_subscriber: bool = True
    moves: bool = True
    hidden: bool = False
    control_input: Literal["", "action", "lead"] = ""
    topic: str = field(init=False)

    def __post_init__(self) -> None:
        name = self.endpoint.topic
        object.__setattr__(
            self, "topic", name if name.startswith("/") else f"/{self.namespace}/{name}"
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class GateRequest:
    """One request of an agent for one endpoint.

    Attributes:
        who: the client, as identified by the transport.
        role: one of `roboneuron.gate.Role`.
        tool: the tool's name.
        robot, endpoint: names in the allow list.
        messages: the encoded message, or every step of a sequence; empty for a read.
        arguments: arguments as sent by the agent, for the audit.
        joints: newest measured joints; needed by endpoints that are `joint_limited`.
        durations_s: duration of each message [s], if known; joints must reach their targets within
            it.
        send_at_s: time of each message, in seconds from now; empty to send `messages` at once.
        predict: computes a motion that `messages` do not hold, for a simulated one; raises
            RefusedError if it would not be completed.
        simulated: only return what would happen.
        repeated: a repetition that belongs to an earlier request; does not count against the rate.
    """

    who: str
    role: str
    tool: str
    robot: str
    endpoint: str
    messages: tuple[Any, ...] = ()
    arguments: Mapping[str, Any] = field(default_factory=dict)
    joints: JointSample | None = None
    durations_s: tuple[float, ...] = ()
    send_at_s: tuple[float, ...] = ()
    predict: Callable[[], None] | None = None
    simulated: bool = False
    repeated: bool = False

    @classmethod
    def of(
        cls,
        context: CallContext,
        tool: str,
        exposed: ExposedEndpoint,
        messages: Sequence[object],
        arguments: Mapping[str, object],
        *,
        joints: JointSample | None = None,
        durations_s: Sequence[float] = (),
        send_at_s: Sequence[float] = (),
    ) -> GateRequest:
        """Create the request for a call; of a simulated call nothing is sent."""
        return cls(
            who=context.who,
            role=context.role,
            tool=tool,
            robot=exposed.robot,
            endpoint=exposed.endpoint.name,
            messages=tuple(messages),
            arguments=arguments,
            joints=joints,
            durations_s=tuple(durations_s),
            send_at_s=tuple(send_at_s),
            simulated=context.simulated,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class TimedCommand:
    """Next command of a motion.

    Attributes:
        message: the message to send; None if only time passes. A message that is not in the gate's
            request is checked by the gate before it is sent.
        due_s: monotonic time of the next one [s].
        stamped: its header gets the time of sending.
    """

    message: Any
    due_s: float
    stamped: bool = False


class MotionClaim(Protocol):
    """A motion in progress with exclusive use of its robot; used by the thread that plays it."""

    def check(self) -> None:
        """Raise if the motion has to end.

        Raises:
            RefusedError: the emergency stop is latched, or the audit failed.
            StateError: the call was cancelled, a policy took over, this process was frozen, or the
                robot was stopped or lost a module since.
        """

    def sleep_until(self, end_s: float) -> None:
        """Wait until this monotonic time [s]; raises as `check`, within 10 ms of the cause."""


class MotionGate(Protocol):
    """Gate for all commands of features. Usable from any thread; blocking methods say so.

    Every message, request and goal is checked before it is sent. A lasting motion has exclusive use
    of its robot. Its stop message or a hold ends it when the call is cancelled, a policy starts, or
    the emergency stop is triggered.
    """

    @property
    def max_duration_s(self) -> float:
        """Longest motion, sequence or goal that a feature may ask for [s]."""

    @property
    def exposed(self) -> tuple[ExposedEndpoint, ...]:
        """Endpoints that agents may use now, of all features; it includes the action topic of an
        arm, hidden. `Events.exposed` announces changes.
        """

    def expose(
        self,
        owner: str,
        endpoints: Sequence[ExposedEndpoint],
        *,
        instead_of_profile: bool = False,
    ) -> None:
        """Set the endpoints of an owner; they replace all its previous ones.

        Args:
            owner: name of the feature.
            endpoints: with names and limits.
            instead_of_profile: the endpoints of the robot's profile are exposed only if they are
                among these.

        Raises:
            ConfigurationError: one may not be exposed, or two contradict each other; the old list
                stays.
            PluginError, MissingDependencyError: the robot's profile cannot be loaded.
        """

    def relimit(self) -> None:
        """Apply the limits that are in force now. Raises as `expose`; the old limits stay then."""

    def check(self, request: GateRequest) -> Verdict:
        """Decide on a request that sends nothing, such as reading, and record the decision.

        Raises:
            RefusedError: refused. A simulated request gets an answer instead.
        """

    def ask(self, exposed: ExposedEndpoint, request: GateRequest) -> Verdict:
        """Check whether a request could be carried out now; otherwise name the rule. `request` is a
        simulated request.
        """

    def slowdown(self, request: GateRequest) -> float:
        """Factor, at least 1, by which the request's duration must grow to respect the TCP's speed
        limits.

        Raises:
            RefusedError: the path cannot be evaluated.
        """

    def joint_limits(self, exposed: ExposedEndpoint) -> Mapping[str, JointLimit]:
        """Limits by joint that commands to an endpoint of an arm keep to now: those of its profile,
        of `[limits]`, and what was tightened.
        """

    def check_free(self, exposed: ExposedEndpoint) -> None:
        """Raise RefusedError while something else moves the robot, unless it moves nothing."""

    def claim(
        self, exposed: ExposedEndpoint, what: str, halt: threading.Event
    ) -> AbstractContextManager[MotionClaim]:
        """Claim exclusive use of the robot's motion.

        Args:
            exposed: endpoint of the motion.
            what: the tool, for messages.
            halt: set when the call is cancelled.

        Raises:
            RefusedError: another client or call moves it.
            NotReadyError: control follows actions and does not reach its hold.
            StateError: as `MotionClaim.check`.
        """

    def end_motions(
        self,
        reason: str,
        timeout_s: float,
        which: Callable[[ExposedEndpoint], bool] = ...,
    ) -> bool:
        """End every motion (through the selected endpoints) and wait; return False if one did not
        end in time.
        """

    def newest_joints(self, exposed: ExposedEndpoint) -> JointSample | None:
        """Measured joints of the endpoint's robot, None without recent ones; never blocks."""

    def joints(self, exposed: ExposedEndpoint, timeout_s: float) -> JointSample | None:
        """Like `newest_joints`, but wait for a recent measurement."""

    def is_served(self, exposed: ExposedEndpoint) -> bool:
        """Return True if the service or action has a server; blocks for a moment for a new action.

        Raises:
            ConfigurationError: the server has another definition of the type, or uses another DDS
                implementation.
        """

    def send_request(
        self, exposed: ExposedEndpoint, request: GateRequest, on_answer: Callable[[], None]
    ) -> tuple[Verdict, Call | None]:
        """Send the request to a service at once, if the gate allows it.

        Args:
            exposed: the service.
            request: contains the one message.
            on_answer: called on the thread of the ROS node when the answer has arrived.

        Returns:
            The gate's verdict, and the pending call; None if nothing was sent.

        Raises:
            RefusedError: the gate refuses, or another client moves the robot.
        """

    def send_goal(
        self,
        exposed: ExposedEndpoint,
        request: GateRequest,
        motion: MotionClaim,
        goal_id: UUID,
        server_s: float,
        on_feedback: Callable[[Any], None],
    ) -> tuple[Verdict, Any]:
        """Send the goal to an action as soon as it has a server, if the gate allows it.

        Args:
            exposed: the action.
            request: contains the one goal.
            motion: the robot's motion, from `claim`.
            goal_id: id for cancelling it while it runs: `cancel_goal` does not pass the gate.
            server_s: longest wait for the action server.
            on_feedback: called with each feedback message, on the thread of the ROS node.

        Returns:
            The gate's verdict, and rclpy's future of the goal handle; None if nothing was sent.

        Raises:
            RefusedError: the gate refuses, also after an emergency stop.
            NotReadyError: the action has no server.
            StateError: the motion has to end.
        """

    def cancel_goal(self, exposed: ExposedEndpoint, goal_id: UUID) -> None:
        """Ask the server of an action to end a goal, by its id, also when the answer to the goal
        was lost. Returns at once.
        """

    def publish_now(
        self, exposed: ExposedEndpoint, request: GateRequest, *, stamped: bool = False
    ) -> Sent | None:
        """Like `publish`, without blocking; None if it would have to wait: then use `publish`."""

    def publish(
        self,
        exposed: ExposedEndpoint,
        request: GateRequest,
        *,
        timeout_s: float,
        stamped: bool = False,
    ) -> Sent:
        """Send one message; blocks.

        Args:
            exposed: the endpoint.
            request: contains the message.
            timeout_s: longest wait for a subscriber.
            stamped: the message's header gets the time of sending.

        Raises:
            RefusedError, NotReadyError, ConfigurationError: as `play`.
        """

    def play(
        self,
        exposed: ExposedEndpoint,
        request: GateRequest,
        commands: Iterable[TimedCommand],
        *,
        total_s: float,
        timeout_s: float,
        halt: threading.Event,
        details: Callable[[], str] = ...,
    ) -> Sent:
        """Wait for a subscriber, claim the robot's motion, send the commands, and end the motion;
        blocks.

        Args:
            exposed: the endpoint.
            request: contains the messages that are known beforehand.
            commands: iterated when the next command is due; an exception from it ends the motion.
            total_s: planned duration of the motion, for error messages.
            timeout_s: longest wait for a subscriber.
            halt: set when the call is cancelled.
            details: additional text for the error of a motion that ended early.

        Raises:
            RefusedError: the gate refuses, another client moves the robot, or the emergency stop
                ended the motion.
            NotReadyError: there is no subscriber.
            StateError: cancelled, or a policy took over.
            ConfigurationError: the topic has another type.
        """
