"""What features ask of the gate, and what it answers: all that moves a robot beside the closed loop
passes it.

The core declares it; one installed feature implements it and lends it as `Host.gate`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from roboneuron.contract import Endpoint, JointSample, RobotProfile

if TYPE_CHECKING:
    from unique_identifier_msgs.msg import UUID

    from roboneuron.ros.link import Call


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ExposedEndpoint:
    """An endpoint of one robot that agents may use.

    Attributes:
        robot: its name.
        namespace: its ROS namespace, without a leading slash.
        label: noun in the names of its tools.
        endpoint: the gate's entry; its name is unique among the robot's.
        profile: the robot's facts, None for a robot that no plugin knows.
        clamp: field paths whose values are moved to the nearest bound instead of refused.
        nonfinite: field paths (without indices) that may hold NaN and infinities.
        require_subscriber: without a subscriber a message is an error.
        moves: it moves the robot, so that it is refused while a policy does.
        hidden: no tools of its own; another tool uses it.
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

    @property
    def topic(self) -> str:
        """Absolute name of the topic, service or action."""
        name = self.endpoint.topic
        return name if name.startswith("/") else f"/{self.namespace}/{name}"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class GateRequest:
    """One thing an agent wants to do with one endpoint.

    Attributes:
        who: which client, as the transport knows it.
        role: one of `roboneuron.gate.Role`.
        tool: the tool's name.
        robot, endpoint: names in the allow list.
        messages: the encoded message, or every step of a sequence; empty for a read.
        arguments: what the agent sent, for the audit.
        joints: newest measured joints; needed by endpoints that are `joint_limited`.
        durations_s: how long each message lasts [s], where that is known; joints must get there
            within that time.
        send_at_s: when each message is to be sent, in seconds from now; empty when `messages` go
            out at once.
        predict: computes a motion that `messages` do not hold, for a dry run; raises RefusedError
            when it would not come to its end.
        dry_run: only answer what would happen.
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
    dry_run: bool = False
    repeated: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Clamp:
    """A value that was moved to a bound: where, what was asked, what is sent."""

    path: str
    asked: float
    sent: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """The gate's answer.

    Attributes:
        allowed: nothing speaks against it.
        dry_run: it was only a question; nothing may be sent even if allowed.
        reason: why not; empty when allowed.
        rule: the rule that refused ("allow_list", "role", "type", "finite", "bounds", "steering",
            "joints", the name of a limit of `[limits]`, "path", "rate", "emergency_stop", "audit");
            empty when allowed.
        clamped: values that were changed in the messages.
    """

    allowed: bool
    dry_run: bool = False
    reason: str = ""
    rule: str = ""
    clamped: tuple[Clamp, ...] = ()

    @property
    def may_send(self) -> bool:
        """Whether the messages are to be sent now."""
        return self.allowed and not self.dry_run


@dataclass(frozen=True, kw_only=True, slots=True)
class TimedCommand:
    """What a motion does next.

    Attributes:
        message: what is sent; None when only time passes. One that is not in the gate's request is
            judged by the gate before it is sent.
        due_s: monotonic time of the next one [s].
        stamped: its header is to carry the time of sending.
    """

    message: Any
    due_s: float
    stamped: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Sent:
    """What was sent, to how many; nothing when `verdict` does not allow it.

    Attributes:
        verdict: the gate's answer.
        messages: repetitions and the stop message included.
        subscribers: how many were matched then.
        duration_s: how long it took.
        stopped: a message that stops was sent at the end.
    """

    verdict: Verdict
    messages: int = 0
    subscribers: int = 0
    duration_s: float = 0.0
    stopped: bool = False


class MotionClaim(Protocol):
    """A motion that is under way and has its robot to itself; used by the thread that plays it."""

    def check(self) -> None:
        """Raise when it has to end.

        Raises:
            RefusedError: the emergency stop is latched, or the audit failed.
            StateError: the call was cancelled, a policy took over, the robot was stopped or has
                lost a module since this motion began, or this process was frozen.
        """

    def sleep_until(self, end_s: float) -> None:
        """Wait until this monotonic time [s]; raises as `check`, within 10 ms of the cause."""


class MotionGate(Protocol):
    """What moves a robot, for features. Usable from any thread; what blocks says so.

    Every message, request and goal is judged before it is sent. Motion that lasts has its robot to
    itself, and is ended by its stop message or a hold when the call is cancelled, a policy starts,
    or the emergency stop is pressed.
    """

    @property
    def max_duration_s(self) -> float:
        """Longest motion, sequence or goal that a feature may ask for [s]."""

    @property
    def exposed(self) -> tuple[ExposedEndpoint, ...]:
        """What agents may use now, by any feature; the action topic of an arm is among it, hidden.
        `Events.exposed` tells of changes.
        """

    def expose(
        self,
        owner: str,
        endpoints: Sequence[ExposedEndpoint],
        *,
        instead_of_profile: bool = False,
    ) -> None:
        """Have these endpoints of an owner and no others of it.

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
        """Judge by the limits that are in force now. Raises as `expose`; the old ones stay then."""

    def check(self, request: GateRequest) -> Verdict:
        """Decide and write the decision down; for requests that send nothing, such as reading.

        Raises:
            RefusedError: refused. A dry run is answered instead.
        """

    def ask(self, exposed: ExposedEndpoint, request: GateRequest) -> Verdict:
        """Whether a request could be carried out now, and if not, by which rule. `request` is a dry
        run.
        """

    def slowdown(self, request: GateRequest) -> float:
        """How many times the request's time the TCP needs to keep to its speeds, at least 1.

        Raises:
            RefusedError: the path cannot be judged.
        """

    def check_free(self, exposed: ExposedEndpoint) -> None:
        """Raise RefusedError while a policy or another call moves the robot; endpoints that move
        nothing are free.
        """

    def claim(
        self, exposed: ExposedEndpoint, what: str, halt: threading.Event
    ) -> AbstractContextManager[MotionClaim]:
        """Own the robot's motion for a while.

        Args:
            exposed: through which endpoint.
            what: the tool, for messages.
            halt: set when the call is cancelled.

        Raises:
            RefusedError: somebody else moves it.
            NotReadyError: control follows actions, and does not come to its hold.
            StateError: as `MotionClaim.check`.
        """

    def end_motions(
        self,
        reason: str,
        timeout_s: float,
        which: Callable[[ExposedEndpoint], bool] = ...,
    ) -> bool:
        """End every motion (through the endpoints that are meant) and wait; False when one did not
        end in time.
        """

    def newest_joints(self, exposed: ExposedEndpoint) -> JointSample | None:
        """The measured joints of the endpoint's robot, None when there are no recent ones; never
        blocks.
        """

    def joints(self, exposed: ExposedEndpoint, timeout_s: float) -> JointSample | None:
        """Like `newest_joints`, and waits for a recent measurement."""

    def is_served(self, exposed: ExposedEndpoint) -> bool:
        """Whether somebody serves the service or action; blocks for a moment when that is new of an
        action.

        Raises:
            ConfigurationError: the server has another definition of the type, or uses another DDS.
        """

    def send_request(
        self, exposed: ExposedEndpoint, request: GateRequest, on_answer: Callable[[], None]
    ) -> tuple[Verdict, Call | None]:
        """Send the request to a service at once, if the gate allows it.

        Args:
            exposed: which service.
            request: holds the one message.
            on_answer: called when the answer is there, on the thread of the ROS node.

        Returns:
            The answer of the gate, and the call on its way; None when nothing was sent.

        Raises:
            RefusedError: the gate, or somebody else moves the robot.
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
        """Send the goal to an action as soon as that is served, if the gate allows it.

        Args:
            exposed: which action.
            request: holds the one goal.
            motion: the robot's motion, from `claim`.
            goal_id: as it is cancelled by, for as long as it runs: `cancel_goal` passes no gate.
            server_s: longest wait for the action server.
            on_feedback: called with each feedback message, on the thread of the ROS node.

        Returns:
            The answer of the gate, and rclpy's future of the goal handle; None when nothing was
            sent.

        Raises:
            RefusedError: the gate; also when the emergency stop was pressed.
            NotReadyError: nobody serves the action.
            StateError: the motion has to end.
        """

    def cancel_goal(self, exposed: ExposedEndpoint, goal_id: UUID) -> None:
        """Ask the server of an action to end a goal, by its id: also when the answer to the goal
        was lost. Returns at once.
        """

    def publish_now(
        self, exposed: ExposedEndpoint, request: GateRequest, *, stamped: bool = False
    ) -> Sent | None:
        """As `publish`, without blocking; None when something has to be waited for first: then
        `publish` it.
        """

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
            exposed: through which endpoint.
            request: holds the message.
            timeout_s: longest wait for a subscriber.
            stamped: the message's header is to carry the time of sending.

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
        """Wait for a subscriber, own the robot's motion, send the commands, bring the motion to its
        end; blocks.

        Args:
            exposed: through which endpoint.
            request: holds the messages that are known beforehand.
            commands: asked for the next one when it is due; what it raises ends the motion.
            total_s: how long the motion is to last, for error messages.
            timeout_s: longest wait for a subscriber.
            halt: set when the call is cancelled.
            details: more to say of a motion that ended early.

        Raises:
            RefusedError: the gate, or somebody else moves the robot; also when the emergency stop
                ended it.
            NotReadyError: nobody subscribes.
            StateError: cancelled, or a policy took over.
            ConfigurationError: the topic carries another type.
        """
