"""call_<name>: a ROS service as a tool."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from rn_tools_ros.arguments import Number, Schema, check_names, object_schema, take_flag
from rn_tools_ros.calls import VERDICT, encode_argument, verdict_fields
from rn_tools_ros.exposed_types import service_of
from rn_tools_ros.schemas import decoded_schema
from rn_tools_ros.service_calls import Response, call
from rn_tools_ros.targets import Targets
from roboneuron.server.motion.exposed import gate_request
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.tool import Answer, CallContext, Stage

TIMEOUT = Number(text="How long to wait for the answer, in seconds.", low=0.0, high=300.0, default=10.0, above=True)


def service_schema(targets: Targets) -> Schema:
    """The output schema; a dry run has no response."""
    interface = service_of(targets.first)
    properties: dict[str, Schema] = {
        "robot": {"type": "string"},
        "service": {"type": "string"},
        "type": {"type": "string"},
        "response": decoded_schema(interface.response),
        "took_s": {"type": "number"},
        **VERDICT,
    }
    return object_schema(properties, [name for name in properties if name != "response"])


class Calling:
    """The handler of one service tool."""

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool
        self._names = [*targets.arguments, "request", "timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        interface = service_of(exposed)
        timeout_s = TIMEOUT.take("timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        message = encode_argument(interface.request, arguments, "request")
        request = gate_request(context, self._tool, exposed, [message], arguments, dry_run=dry_run)
        halt = threading.Event()

        def work(_: Stage) -> Response:
            return call(self._gate, exposed, request, timeout_s, halt)

        response = await context.run(work, on_cancel=halt.set)
        structured: dict[str, Any] = {
            "robot": exposed.robot,
            "service": exposed.topic,
            "type": exposed.endpoint.type,
            "took_s": round(response.took_s, 6),
            **verdict_fields(response.verdict),
        }
        if response.message is not None:
            structured["response"] = interface.response.decode(response.message)
        return Answer(structured=structured)
