"""Goals of ROS actions, sent through the gate; every goal ends with its call."""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from roboneuron.direct_path.delivery import Ending, MotionEnd
from roboneuron.direct_path.message_types import RosMessage
from roboneuron.errors import NotReadyError, RoboNeuronError, StateError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionClaim, MotionGate
from roboneuron.server.verdict import Verdict

_POLL_S = 0.01
_STATUS_WORDS = {4: "succeeded", 5: "canceled", 6: "aborted"}
"""Words for the ends of a goal. Source: action_msgs/msg/GoalStatus."""
_ANSWER_S = 5.0
_CANCEL_S = 2.0
"""Time for the server to confirm the cancellation of a goal."""
_JOINTS_S = 1.0
_REACHED_RAD = 0.1
_REASON_S = 0.5
"""Time in which the robot reports why it has replaced a goal by a hold; it reports every 0.25 s."""


class _DoneFuture(Protocol):
    """A completed future of rclpy."""

    def result(self) -> Any: ...


class _SentGoal:
    """A goal that was sent. `accepted` and `outcome` are None until the server answers."""

    def __init__(self, cancel: Callable[[], None]) -> None:
        self._cancel = cancel
        self._changed = threading.Event()
        self._cancel_wanted = False
        self.accepted: bool | None = None
        self.outcome: Any = None  # the response of the get_result service

    @property
    def status(self) -> str:
        """Final status: "succeeded", "canceled", "aborted" or "unknown"; empty before the end."""
        return "" if self.outcome is None else _STATUS_WORDS.get(self.outcome.status, "unknown")

    def wait(self, done: Callable[[], bool], timeout_s: float, check: Callable[[], None]) -> bool:
        """Wait until `done`; `check` is called at least every 10 ms and may raise. Returns False
        after `timeout_s`.
        """
        deadline_s = time.monotonic() + timeout_s
        while not done():
            check()
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                return False
            self._changed.wait(min(_POLL_S, remaining_s))
            self._changed.clear()
        return True

    def cancel(self) -> None:
        """Ask the server to end the goal, by its id, also when the answer to the goal was lost.
        Returns at once.
        """
        self._cancel_wanted = True
        self._cancel()

    def on_answer(self, future: _DoneFuture) -> None:
        """Handle the server's acceptance or rejection; called on the thread of the ROS node."""
        handle = future.result()
        self.accepted = bool(handle is not None and handle.accepted)
        if self.accepted:
            handle.get_result_async().add_done_callback(self._on_result)
            if self._cancel_wanted:
                self._cancel()
        self._changed.set()

    def _on_result(self, future: _DoneFuture) -> None:
        self.outcome = future.result()
        self._changed.set()


@dataclass(frozen=True, kw_only=True, slots=True)
class GoalEnd:
    """End of a goal.

    Attributes:
        verdict: the gate's answer.
        status: "succeeded", "aborted" ...; empty when nothing was sent.
        result: the result message; None when nothing was sent.
        took_s: time from sending to the result.
    """

    verdict: Verdict
    status: str = ""
    result: object = None
    took_s: float = 0.0


def send_goal(
    gate: MotionGate,
    exposed: ExposedEndpoint,
    request: GateRequest,
    *,
    timeout_s: float,
    server_s: float,
    halt: threading.Event,
    on_feedback: Callable[[RosMessage], None],
    watch: Callable[[], None],
) -> GoalEnd:
    """Claim the robot's motion, send the goal and wait for its result; blocks.

    Args:
        gate: sends the goal.
        exposed: the action.
        request: contains the goal.
        timeout_s: longest time for the goal; it is cancelled then.
        server_s: longest wait for the action server.
        halt: set when the call is cancelled.
        on_feedback: called with each feedback message, on the executor's thread.
        watch: called at least every 10 ms until the goal has ended; an exception from it ends the
            goal.

    Raises:
        RefusedError: the gate refuses, another client moves the robot, or the emergency stop or
            `watch` ended the goal.
        NotReadyError: the action has no server, or it did not end in time.
        StateError: rejected, cancelled, or a policy took over.
    """
    if exposed.endpoint.joint_limited and request.joints is None:
        request = replace(request, joints=gate.joints(exposed, server_s))
    if request.simulated:
        return GoalEnd(verdict=gate.ask(exposed, request))
    with gate.claim(exposed, request.tool, halt) as motion:
        return _follow(gate, exposed, request, motion, timeout_s, server_s, on_feedback, watch)


def _follow(
    gate: MotionGate,
    exposed: ExposedEndpoint,
    request: GateRequest,
    motion: MotionClaim,
    timeout_s: float,
    server_s: float,
    on_feedback: Callable[[RosMessage], None],
    watch: Callable[[], None],
) -> GoalEnd:
    from unique_identifier_msgs.msg import UUID  # heavy

    goal_id = UUID(uuid=list(uuid.uuid4().bytes))
    started_s = time.monotonic()
    goal = _SentGoal(lambda: gate.cancel_goal(exposed, goal_id))
    verdict, answer = gate.send_goal(exposed, request, motion, goal_id, server_s, on_feedback)
    if answer is None:
        return GoalEnd(verdict=verdict)
    answer.add_done_callback(goal.on_answer)
    try:
        if not goal.wait(lambda: goal.accepted is not None, _ANSWER_S, motion.check):
            raise NotReadyError(f"{exposed.topic} did not answer the goal within {_ANSWER_S:g} s.")
        if not goal.accepted:
            raise StateError(
                f"{exposed.topic} rejected the goal.", hint="Look at the values of the goal."
            )

        def check() -> None:
            motion.check()
            watch()

        if not goal.wait(lambda: goal.outcome is not None, timeout_s, check):
            raise NotReadyError(f"The goal of {exposed.topic} did not end within {timeout_s:g} s.")
        if goal.status == "succeeded" and (told := _not_reached(gate, exposed, request)):
            goal.wait(lambda: False, _REASON_S, motion.check)
            raise StateError(told, hint="Another command has replaced the goal: see who sends one.")
    except RoboNeuronError as error:
        if goal.accepted is False:
            raise
        goal.cancel()
        ended = goal.wait(lambda: goal.outcome is not None, _CANCEL_S, lambda: None)
        MotionEnd(
            after_s=time.monotonic() - started_s,
            ending=Ending.GOAL_ENDED if ended else Ending.GOAL_UNCONFIRMED,
            details=goal.status if ended else "",
            cause=error,
        ).check()
    took_s = time.monotonic() - started_s
    return GoalEnd(verdict=verdict, status=goal.status, result=goal.outcome.result, took_s=took_s)


def _not_reached(gate: MotionGate, exposed: ExposedEndpoint, request: GateRequest) -> str:
    """What is measured elsewhere than at the end of a trajectory that is told to be reached; empty
    if nothing is.

    A controller that gets another trajectory by its topic follows that one, and tells its end as
    that of the goal. Source: joint_trajectory_controller of ros2_controllers, whose topic ends no
    goal.
    """
    trajectory: Any = getattr(request.messages[0], "trajectory", None)
    if not exposed.endpoint.joint_limited or not getattr(trajectory, "points", None):
        return ""
    measured = gate.joints(exposed, _JOINTS_S)
    if measured is None:
        return ""
    now = dict(zip(measured.names, measured.position.tolist(), strict=True))
    for name, goal in zip(trajectory.joint_names, trajectory.points[-1].positions, strict=True):
        away = abs(math.remainder(now.get(name, goal) - goal, math.tau))
        if away > _REACHED_RAD:
            return (
                f"{exposed.topic} reports that its goal is reached, but {name} is measured "
                f"{away:.2f} away from it."
            )
    return ""
