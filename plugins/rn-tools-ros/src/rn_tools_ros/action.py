"""send_<name>_goal: a ROS action as a tool; feedback is progress, and no goal outlives the call that sent it."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from typing import Any

from rn_tools_ros.arguments import Number, Schema, check_names, object_schema, take_flag
from rn_tools_ros.calls import VERDICT, encode_argument, verdict_fields
from rn_tools_ros.exposed_types import action_of
from rn_tools_ros.goals import GoalEnd, send_goal
from rn_tools_ros.interfaces import ActionInterface
from rn_tools_ros.schemas import decoded_schema
from rn_tools_ros.targets import Targets
from roboneuron.errors import StateError
from roboneuron.server.motion.exposed import gate_request
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.tool import Answer, CallContext, Stage

_FEEDBACK_PERIOD_S = 0.1
SERVER = Number(text="How long to wait for the action server, in seconds.", low=0.0, high=60.0, default=2.0)


def goal_schema(targets: Targets) -> Schema:
    """The output schema; a dry run has no result."""
    interface = action_of(targets.first)
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

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool
        self.timeout = timeout_argument(gate)
        self._names = [*targets.arguments, "goal", "timeout_s", "server_timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        interface = action_of(exposed)
        timeout_s = self.timeout.take("timeout_s", arguments)
        server_s = SERVER.take("server_timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        message = encode_argument(interface.goal, arguments, "goal")
        request = gate_request(
            context, self._tool, exposed, [message], arguments, dry_run=dry_run,
            joints=self._gate.newest_joints(exposed) if exposed.endpoint.joint_limited else None,
        )  # fmt: skip
        halt = threading.Event()

        def work(stage: Stage) -> tuple[GoalEnd, _Progress]:
            progress = _Progress(interface, stage)
            end = send_goal(
                self._gate, exposed, request,
                timeout_s=timeout_s, server_s=server_s, halt=halt, on_feedback=progress.take,
            )  # fmt: skip
            return end, progress

        end, progress = await context.run(work, on_cancel=halt.set, on_leave=halt.set)
        structured: dict[str, Any] = {
            "robot": exposed.robot,
            "action": exposed.topic,
            "type": exposed.endpoint.type,
            "status": end.status,
            "feedbacks": progress.count,
            "took_s": round(end.took_s, 6),
            **verdict_fields(end.verdict),
        }
        if end.status:
            result = structured["result"] = interface.result.decode(end.result)
            if end.status != "succeeded":
                raise StateError(
                    f"The goal of {exposed.topic} was {end.status} after {end.took_s:.2f} s; "
                    f"result: {json.dumps(result)[:500]}."
                )
        return Answer(structured=structured)


def timeout_argument(gate: MotionGate) -> Number:
    """How long a goal may take."""
    return Number(
        text="How long the goal may take, in seconds; then it is cancelled.",
        low=0.0, high=gate.max_duration_s, default=min(60.0, gate.max_duration_s), above=True,
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
