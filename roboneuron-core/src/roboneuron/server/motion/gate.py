"""The gate as features use it: they say what is to be sent, and it is judged and sent here; nobody gets a publisher."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from roboneuron.contract import JointSample, Pose
from roboneuron.errors import StateError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.server.motion import delivery, goals, services
from roboneuron.server.motion.access import Access
from roboneuron.server.motion.allow_list import AllowList
from roboneuron.server.motion.delivery import Command, Step
from roboneuron.server.motion.ending import Sent
from roboneuron.server.motion.exposed import Exposed
from roboneuron.server.motion.goals import GoalEnd
from roboneuron.server.motion.services import Response
from roboneuron.server.tool import Stage

if TYPE_CHECKING:
    from roboneuron.ros.reader import Reading


class MotionGate:
    """What moves a robot, for features. Usable from any thread; what blocks says so.

    Every message passes the gate before it is sent. Motion that lasts has its robot to itself, and is ended by its
    stop message or a hold when the call is cancelled, a policy starts, or the emergency stop is pressed.
    """

    def __init__(self, access: Access, allow_list: AllowList, max_duration_s: float) -> None:
        self._access = access
        self._allow_list = allow_list
        self.max_duration_s = max_duration_s
        """Longest motion, sequence or goal that a feature may ask for [s]."""

    @property
    def exposed(self) -> tuple[Exposed, ...]:
        """What agents may use now, by any feature; the action topic of an arm is among it, hidden."""
        return self._allow_list.exposed

    def expose(self, owner: str, endpoints: Sequence[Exposed], *, instead_of_profile: bool = False) -> None:
        """Have these endpoints of a feature and no others of it; see `AllowList.expose`."""
        self._allow_list.expose(owner, endpoints, instead_of_profile=instead_of_profile)

    def on_change(self, listener: Callable[[], object]) -> None:
        """Call `listener` after each change of `exposed`, from the thread that made it."""
        self._allow_list.on_change(listener)

    def check(self, request: GateRequest) -> Verdict:
        """Judge a request that sends nothing, such as reading; it is written down. Raises RefusedError."""
        return self._access.gate.check(request)

    def ask(self, exposed: Exposed, request: GateRequest) -> Verdict:
        """Whether a request could be carried out now, and if not, by which rule. `request` is a dry run."""
        return self._access.ask(exposed, request)

    def check_free(self, exposed: Exposed) -> None:
        """Raise RefusedError while a policy or another call moves the robot; endpoints that move nothing are free."""
        self._access.arbiter.check_free(exposed)

    def slowdown(self, request: GateRequest) -> float:
        """How many times the request's time the TCP needs to keep to its speeds; see `Gate.slowdown`."""
        return self._access.gate.slowdown(request)

    def newest_joints(self, exposed: Exposed) -> JointSample | None:
        """The measured joints of the endpoint's robot, None when there are no recent ones; never blocks."""
        return self._access.traffic.newest_joints(exposed)

    def joints(self, exposed: Exposed, timeout_s: float) -> JointSample | None:
        """Like `newest_joints`, and waits for a first measurement; blocks."""
        return self._access.traffic.joints(exposed, timeout_s)

    def ee_pose(self, exposed: Exposed, timeout_s: float) -> Pose:
        """The measured pose of the TCP of the endpoint's robot, in its base frame; blocks. Raises NotReadyError."""
        return self._access.traffic.ee_pose(exposed, timeout_s)

    def read(self, exposed: Exposed, *, count: int, timeout_s: float, halt: threading.Event) -> Reading:
        """The latched message of a topic, or the next ones; blocks. `check` the request first.

        Raises:
            ConfigurationError: the topic carries another type.
            StateError: cancelled.
        """
        from roboneuron.ros.reader import Cancelled, read_messages  # heavy

        try:
            return read_messages(
                self._access.traffic.link(), exposed.ros_type, exposed.endpoint.type, exposed.topic,
                count=count, timeout_s=timeout_s, cancelled=halt,
            )  # fmt: skip
        except Cancelled:
            raise StateError("The call was cancelled.") from None

    def publish_now(self, exposed: Exposed, request: GateRequest) -> Sent | None:
        """Send one message without blocking; None when something has to be waited for first: then `publish` it."""
        return delivery.publish_now(self._access, exposed, request)

    def publish(
        self, exposed: Exposed, request: GateRequest, steps: Sequence[Step], *, timeout_s: float, stage: Stage,
        halt: threading.Event,
    ) -> Sent:  # fmt: skip
        """Send one message, or steps that last and follow each other; blocks.

        Args:
            exposed: through which endpoint.
            request: holds the messages of the steps.
            steps: at least one.
            timeout_s: longest wait for a subscriber.
            stage: told how far it has come.
            halt: set when the call is cancelled.

        Raises:
            RefusedError, NotReadyError, StateError, ConfigurationError: as `play`.
        """
        if not any(step.duration_s for step in steps):
            return delivery.publish(self._access, exposed, request, steps[0], timeout_s)
        commands = delivery.commands_of(steps, exposed.endpoint.repeat_hz, stage)
        total_s = sum(step.duration_s for step in steps)
        return self.play(exposed, request, commands, total_s=total_s, timeout_s=timeout_s, halt=halt)

    def play(
        self, exposed: Exposed, request: GateRequest, commands: Iterable[Command], *, total_s: float, timeout_s: float,
        halt: threading.Event, details: Callable[[], str] = lambda: "",
    ) -> Sent:  # fmt: skip
        """Move the robot by commands that are asked for one by one; blocks. See `delivery.play`.

        Raises:
            RefusedError: the gate, or somebody else moves the robot; also when the emergency stop ended it.
            NotReadyError: nobody subscribes.
            StateError: cancelled, or a policy took over.
            ConfigurationError: the topic carries another type.
        """
        return delivery.play(
            self._access, exposed, request, commands,
            total_s=total_s, timeout_s=timeout_s, halt=halt, details=details,
        )  # fmt: skip

    def call(self, exposed: Exposed, request: GateRequest, *, timeout_s: float, halt: threading.Event) -> Response:
        """Call a service; blocks. Raises as `services.call`."""
        return services.call(self._access, exposed, request, timeout_s, halt)

    def read_parameters(
        self, ros_type: Any, name: str, message: Any, *, timeout_s: float, halt: threading.Event
    ) -> Any:
        """Ask a parameter service that changes nothing; blocks. `check` the request first. Raises as `call`."""
        return services.read_parameters(self._access, ros_type, name, message, timeout_s, halt)

    def send_goal(
        self, exposed: Exposed, request: GateRequest, *, timeout_s: float, server_s: float, halt: threading.Event,
        on_feedback: Callable[[Any], None],
    ) -> GoalEnd:  # fmt: skip
        """Send a goal and wait for its result; blocks. See `goals.send_goal`."""
        return goals.send_goal(
            self._access, exposed, request,
            timeout_s=timeout_s, server_s=server_s, halt=halt, on_feedback=on_feedback,
        )  # fmt: skip

    def end_motions(self, reason: str, timeout_s: float, which: Callable[[Exposed], bool]) -> bool:
        """End motions through the endpoints that are meant and wait; False when one did not end in time."""
        return self._access.arbiter.end_all(reason, timeout_s, which)
