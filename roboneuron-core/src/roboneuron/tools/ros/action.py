"""Tool send_<name>_goal for a ROS action: feedback is reported as progress, and every goal ends
with its call.
"""

from __future__ import annotations

import json
import threading
import time
from typing import Any, Literal

from pydantic import Field

from roboneuron.direct_path.derived import Derived
from roboneuron.direct_path.message_types import RosMessage
from roboneuron.direct_path.places import check_way
from roboneuron.errors import RefusedError, StateError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate
from roboneuron.server.tool import CallContext
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.ros.calls import Judged, RobotCall, Value, verdict_fields
from roboneuron.tools.ros.exposed_types import action_of
from roboneuron.tools.ros.goals import GoalEnd, send_goal
from roboneuron.tools.ros.interfaces import ActionInterface
from roboneuron.tools.ros.schemas import decoded_schema
from roboneuron.tools.ros.targets import Targets

_FEEDBACK_PERIOD_S = 0.1
_LONGEST_S = 60.0


class SendGoal(RobotCall):
    """Arguments of an action tool."""

    goal: Value = Field(default_factory=dict)
    timeout_s: float | None = Field(
        default=None,
        gt=0,
        description="Timeout of the goal [s]; then it is cancelled.",
    )
    server_timeout_s: float = Field(
        default=2.0, ge=0, le=60, description="Longest wait for the action server [s]."
    )


class GoalResult(Judged):
    """End of the goal; a simulated call has no result."""

    robot: str
    action: str
    type: str
    status: Literal["succeeded", ""] = Field(description="empty when simulated")
    result: Value = Field(default_factory=dict)
    feedbacks: int = Field(description="number of feedback messages")
    took_s: float


def goal_model(targets: Targets) -> Derived[GoalResult]:
    """Return the result model, with the schema of the action's decoded result."""
    interface = action_of(targets.first)
    own: dict[str, dict[str, object]] = {name: {} for name in GoalResult.model_fields}
    required = [name for name in own if name != "result"]
    return Derived(
        model=GoalResult,
        properties=own | {"result": decoded_schema(interface.result)},
        required=required,
    )


class GoalSending:
    """The handler of one action tool."""

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool
        self.timeout_s = min(_LONGEST_S, gate.max_duration_s)

    async def __call__(self, arguments: SendGoal, context: CallContext) -> GoalResult:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        exposed = self._targets.of(arguments.robot)
        interface = action_of(exposed)
        timeout_s = arguments.timeout_s or self.timeout_s
        message = interface.goal.encode(arguments.goal, now_ns=time.time_ns(), argument="goal")
        request = GateRequest.of(
            context,
            self._tool,
            exposed,
            [message],
            arguments.given(),
            joints=self._gate.newest_joints(exposed) if exposed.endpoint.joint_limited else None,
        )
        halt = threading.Event()

        def work(stage: Stage) -> tuple[GoalEnd, _Progress]:
            progress = _Progress(interface, exposed, stage)
            end = send_goal(
                self._gate,
                exposed,
                request,
                timeout_s=timeout_s,
                server_s=arguments.server_timeout_s,
                halt=halt,
                on_feedback=progress.take,
                watch=progress.check,
            )
            return end, progress

        end, progress = await context.run(work, on_cancel=halt.set, on_leave=halt.set)
        decoded: dict[str, Any] = (
            {"result": interface.result.decode(end.result)} if end.status else {}
        )
        if end.status not in ("succeeded", ""):
            raise StateError(
                f"The goal of {exposed.topic} was {end.status} after {end.took_s:.2f} s; "
                f"result: {json.dumps(decoded['result'])[:500]}."
            )
        return GoalResult(
            robot=exposed.robot,
            action=exposed.topic,
            type=exposed.endpoint.type,
            status="succeeded" if end.status else "",
            feedbacks=progress.count,
            took_s=round(end.took_s, 6),
            **verdict_fields(end.verdict),
            **decoded,
        )


class _Progress:
    """Converts feedback to progress reports at a limited rate, and checks the places in it."""

    def __init__(self, interface: ActionInterface, exposed: ExposedEndpoint, stage: Stage) -> None:
        self._interface = interface
        self._endpoint = exposed.endpoint
        self._stage = stage
        self._told_s = 0.0
        self._violation: RefusedError | None = None
        self.count = 0

    def check(self) -> None:
        """Raise RefusedError if the feedback has contained a place in a zone."""
        if self._violation is not None:
            raise self._violation

    def take(self, feedback: RosMessage) -> None:
        """Process a feedback message; called on the executor's thread."""
        self.count += 1
        if self._endpoint.zones and self._violation is None:
            try:
                check_way(self._endpoint, feedback)
            except RefusedError as error:
                self._violation = error
        now_s = time.monotonic()
        if now_s - self._told_s >= _FEEDBACK_PERIOD_S:
            self._told_s = now_s
            self._stage(json.dumps(self._interface.feedback.decode(feedback))[:1000])
