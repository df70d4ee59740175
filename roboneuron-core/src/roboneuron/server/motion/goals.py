"""Goals of ROS actions through the gate; no goal outlives the call that sent it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from roboneuron.errors import NotReadyError, RoboNeuronError, StateError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.server.motion.access import Access
from roboneuron.server.motion.arbiter import Motion
from roboneuron.server.motion.ending import Ending, MotionEnd
from roboneuron.server.motion.exposed import Exposed

_ANSWER_S = 5.0
_CANCEL_S = 2.0
"""How long the server gets to confirm that a goal was cancelled."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GoalEnd:
    """What became of a goal.

    Attributes:
        verdict: the gate's answer.
        status: "succeeded", "aborted" ...; empty when nothing was sent.
        result: the result message; None when nothing was sent.
        took_s: time from sending to the result.
    """

    verdict: Verdict
    status: str = ""
    result: Any = None
    took_s: float = 0.0


def send_goal(
    access: Access, exposed: Exposed, request: GateRequest, *, timeout_s: float, server_s: float,
    halt: threading.Event, on_feedback: Callable[[Any], None],
) -> GoalEnd:  # fmt: skip
    """Own the robot's motion, send the goal and wait for its result; blocks.

    Args:
        access: the gate and what lies behind it.
        exposed: which action.
        request: holds the goal.
        timeout_s: longest time for the goal; it is cancelled then.
        server_s: longest wait for the action server.
        halt: set when the call is cancelled.
        on_feedback: called with each feedback message, on the executor's thread.

    Raises:
        RefusedError: the gate, or somebody else moves the robot; also when the emergency stop ended it.
        NotReadyError: nobody serves the action, or it did not end in time.
        StateError: rejected, cancelled, or a policy took over.
    """
    if exposed.endpoint.joint_limited and request.joints is None:
        request = replace(request, joints=access.traffic.joints(exposed, server_s))
    if request.dry_run:
        return GoalEnd(verdict=access.ask(exposed, request))
    with access.arbiter.claim(exposed, request.tool, halt) as motion:
        verdict = access.gate.check(request)
        if not verdict.may_send:
            return GoalEnd(verdict=verdict)
        return _follow(access, exposed, request, verdict, motion, timeout_s, server_s, on_feedback)


def _follow(
    access: Access, exposed: Exposed, request: GateRequest, verdict: Verdict, motion: Motion, timeout_s: float,
    server_s: float, on_feedback: Callable[[Any], None],
) -> GoalEnd:  # fmt: skip
    client = access.traffic.goal_client(exposed)
    deadline_s = time.monotonic() + server_s
    while not client.is_ready():
        if time.monotonic() >= deadline_s:
            raise NotReadyError(f"Nobody serves the action {exposed.topic}: nothing was sent.", hint="Start it.")
        motion.sleep_until(min(deadline_s, time.monotonic() + 0.02))
    started_s = time.monotonic()
    goal = client.send(request.messages[0], on_feedback)
    try:
        if not goal.wait(lambda: goal.accepted is not None, _ANSWER_S, motion.check):
            raise NotReadyError(f"{exposed.topic} did not answer the goal within {_ANSWER_S:g} s.")
        if not goal.accepted:
            raise StateError(f"{exposed.topic} rejected the goal.", hint="Look at the values of the goal.")
        if not goal.wait(lambda: goal.outcome is not None, timeout_s, motion.check):
            raise NotReadyError(f"The goal of {exposed.topic} did not end within {timeout_s:g} s.")
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
