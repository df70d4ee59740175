"""Tool call_<name> for a ROS service."""

from __future__ import annotations

import threading
import time
from typing import Any

from pydantic import Field

from roboneuron.direct_path.derived import Derived
from roboneuron.server.motion_gate import GateRequest, MotionGate
from roboneuron.server.tool import CallContext
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.ros.calls import Judged, RobotCall, Value, verdict_fields
from roboneuron.tools.ros.exposed_types import service_of
from roboneuron.tools.ros.schemas import decoded_schema
from roboneuron.tools.ros.service_calls import Response, call
from roboneuron.tools.ros.targets import Targets


class CallService(RobotCall):
    """Arguments of a service tool."""

    request: Value = Field(default_factory=dict)
    timeout_s: float = Field(default=10.0, gt=0, le=300, description="Timeout of the answer [s].")


class ServiceAnswer(Judged):
    """Answer of the service; empty when simulated."""

    robot: str
    service: str
    type: str
    response: Value = Field(default_factory=dict)
    took_s: float


def served_model(targets: Targets) -> Derived[ServiceAnswer]:
    """Return the result model, with the schema of the response; a simulated call has none."""
    interface = service_of(targets.first)
    own: dict[str, dict[str, object]] = {name: {} for name in ServiceAnswer.model_fields}
    required = [name for name in own if name != "response"]
    return Derived(
        model=ServiceAnswer,
        properties=own | {"response": decoded_schema(interface.response)},
        required=required,
    )


class Calling:
    """The handler of one service tool."""

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool

    async def __call__(self, arguments: CallService, context: CallContext) -> ServiceAnswer:
        """Raises InvalidInputError, RefusedError, NotReadyError."""
        exposed = self._targets.of(arguments.robot)
        interface = service_of(exposed)
        message = interface.request.encode(
            arguments.request, now_ns=time.time_ns(), argument="request"
        )
        request = GateRequest.of(
            context, self._tool, exposed, [message], arguments.given()
        )  # fmt: skip
        halt = threading.Event()

        def work(_: Stage) -> Response:
            return call(self._gate, exposed, request, arguments.timeout_s, halt)

        response = await context.run(work, on_cancel=halt.set)
        decoded: dict[str, Any] = (
            {}
            if response.message is None
            else {"response": interface.response.decode(response.message)}
        )
        return ServiceAnswer(
            robot=exposed.robot,
            service=exposed.topic,
            type=exposed.endpoint.type,
            took_s=round(response.took_s, 6),
            **verdict_fields(response.verdict),
            **decoded,
        )
