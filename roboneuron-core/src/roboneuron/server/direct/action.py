"""send_<name>_goal: a ROS action as a tool; feedback is progress, and no goal outlives the call that sent it."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from roboneuron.errors import NotReadyError, RoboNeuronError, StateError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.interfaces import ActionInterface
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Number, Schema, check_names, object_schema, take_flag
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.motion import Motion
from roboneuron.server.direct.request import VERDICT, encode_argument, gate_request, judge_dry_run, verdict_fields
from roboneuron.server.direct.schemas import decoded_schema
from roboneuron.server.direct.targets import Targets
from roboneuron.server.tool import Answer, CallContext, Stage

_ANSWER_S = 5.0
_CANCEL_S = 2.0
"""How long the server gets to confirm that a goal was cancelled."""
_FEEDBACK_PERIOD_S = 0.1
SERVER = Number(text="How long to wait for the action server, in seconds.", low=0.0, high=60.0, default=2.0)


def goal_schema(targets: Targets) -> Schema:
    """The output schema; a dry run has no result."""
    interface = targets.first.interface
    assert isinstance(interface, ActionInterface)
    properties: dict[str, Schema] = {
        "robot": {"type": "string"},
        "action": {"type": "string"},
        "type": {"type": "string"},
        "status": {"type": "string", "enum": ["succeeded", ""], "description": "empty in a dry run"},
        "result": decoded_schema(interface.result),
        "feedbacks": {"type": "integer", "description": "how many feedback messages came"},
        "took_s": {"type": "number"},
        **VERDICT,
    }
    return object_schema(properties, [name for name in properties if name != "result"])


class GoalSending:
    """The handler of one action tool."""

    def __init__(self, access: Access, targets: Targets, tool: str) -> None:
        self._access = access
        self._targets = targets
        self._tool = tool
        self.timeout = timeout_argument(access)
        self._names = [*targets.arguments, "goal", "timeout_s", "server_timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        interface = exposed.interface
        assert isinstance(interface, ActionInterface)
        timeout_s = self.timeout.take("timeout_s", arguments)
        server_s = SERVER.take("server_timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        message = encode_argument(interface.goal, arguments, "goal")
        request = gate_request(
            context, self._tool, exposed, [message], arguments, dry_run=dry_run,
            joints=self._access.traffic.newest_joints(exposed) if exposed.endpoint.joint_limited else None,
        )  # fmt: skip
        halt = threading.Event()
        return await context.run(
            lambda stage: self._run(exposed, request, timeout_s, server_s, stage, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )

    def _run(
        self, exposed: Exposed, request: GateRequest, timeout_s: float, server_s: float, stage: Stage,
        halt: threading.Event,
    ) -> Answer:  # fmt: skip
        if exposed.endpoint.joint_limited and request.joints is None:
            request = replace(request, joints=self._access.traffic.joints(exposed, server_s))
        if request.dry_run:
            return _answer(exposed, judge_dry_run(self._access, exposed, request))
        with self._access.desk.claim(exposed, self._tool, halt) as motion:
            verdict = self._access.gate.check(request)
            if not verdict.may_send:
                return _answer(exposed, verdict)
            return self._follow(exposed, request, verdict, motion, timeout_s, server_s, stage)

    def _follow(
        self, exposed: Exposed, request: GateRequest, verdict: Verdict, motion: Motion, timeout_s: float,
        server_s: float, stage: Stage,
    ) -> Answer:  # fmt: skip
        interface = exposed.interface
        assert isinstance(interface, ActionInterface)
        client = self._access.traffic.goal_client(exposed)
        deadline_s = time.monotonic() + server_s
        while not client.is_ready():
            if time.monotonic() >= deadline_s:
                raise NotReadyError(f"Nobody serves the action {exposed.topic}: nothing was sent.", hint="Start it.")
            motion.sleep_until(min(deadline_s, time.monotonic() + 0.02))
        progress = _Progress(interface, stage)
        started_s = time.monotonic()
        goal = client.send(request.messages[0], progress.take)
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
            state = f"the goal was ended ({goal.status})" if ended else "the goal was asked to end, but did not confirm"
            cause = error.message.replace(" Nothing was sent.", "")
            raise type(error)(
                f"{cause} After {time.monotonic() - started_s:.2f} s {state}.", hint=error.hint
            ) from error
        took_s = time.monotonic() - started_s
        result = interface.result.decode(goal.outcome.result)
        if goal.status != "succeeded":
            raise StateError(
                f"The goal of {exposed.topic} was {goal.status} after {took_s:.2f} s; "
                f"result: {json.dumps(result)[:500]}."
            )
        answer = _answer(exposed, verdict, took_s=took_s)
        outcome = {"status": "succeeded", "result": result, "feedbacks": progress.count}
        return replace(answer, structured={**answer.structured, **outcome})


def timeout_argument(access: Access) -> Number:
    """How long a goal may take."""
    return Number(
        text="How long the goal may take, in seconds; then it is cancelled.",
        low=0.0, high=access.max_duration_s, default=min(60.0, access.max_duration_s), above=True,
    )  # fmt: skip


class _Progress:
    """Turns feedback into progress, not more often than an agent can use."""

    def __init__(self, interface: ActionInterface, stage: Stage) -> None:
        self._interface = interface
        self._stage = stage
        self._told_s = 0.0
        self.count = 0

    def take(self, feedback: Any) -> None:
        """Called on the executor's thread."""
        self.count += 1
        now_s = time.monotonic()
        if now_s - self._told_s >= _FEEDBACK_PERIOD_S:
            self._told_s = now_s
            self._stage(json.dumps(self._interface.feedback.decode(feedback))[:1000])


def _answer(exposed: Exposed, verdict: Verdict, took_s: float = 0.0) -> Answer:
    return Answer(
        structured={
            "robot": exposed.robot,
            "action": exposed.topic,
            "type": exposed.endpoint.type,
            "status": "",
            "feedbacks": 0,
            "took_s": round(took_s, 6),
            **verdict_fields(verdict),
        }
    )
