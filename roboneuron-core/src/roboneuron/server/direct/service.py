"""call_<name>: a ROS service as a tool."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from roboneuron.errors import NotReadyError, StateError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.interfaces import ServiceInterface
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Number, Schema, check_names, object_schema, take_flag
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.request import VERDICT, encode_argument, gate_request, judge_dry_run, verdict_fields
from roboneuron.server.direct.schemas import decoded_schema
from roboneuron.server.direct.targets import Targets
from roboneuron.server.direct.traffic import Traffic
from roboneuron.server.tool import Answer, CallContext
from roboneuron.supervisor.changes import Changes

TIMEOUT = Number(text="How long to wait for the answer, in seconds.", low=0.0, high=300.0, default=10.0, above=True)


def service_schema(targets: Targets) -> Schema:
    """The output schema; a dry run has no response."""
    interface = targets.first.interface
    assert isinstance(interface, ServiceInterface)
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

    def __init__(self, access: Access, targets: Targets, tool: str) -> None:
        self._access = access
        self._targets = targets
        self._tool = tool
        self._names = [*targets.arguments, "request", "timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        interface = exposed.interface
        assert isinstance(interface, ServiceInterface)
        timeout_s = TIMEOUT.take("timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        message = encode_argument(interface.request, arguments, "request")
        request = gate_request(context, self._tool, exposed, [message], arguments, dry_run=dry_run)
        halt = threading.Event()
        return await context.run(lambda _: self._call(exposed, request, timeout_s, halt), on_cancel=halt.set)

    def _call(self, exposed: Exposed, request: GateRequest, timeout_s: float, halt: threading.Event) -> Answer:
        if exposed.endpoint.joint_limited:
            request = replace(request, joints=self._access.traffic.joints(exposed, min(timeout_s, 2.0)))
        if request.dry_run:
            return _answer(exposed, judge_dry_run(self._access, exposed, request))
        self._access.desk.check_free(exposed)
        interface = exposed.interface
        assert isinstance(interface, ServiceInterface)
        started_s = time.monotonic()
        await_service(self._access.traffic, interface.ros_type, exposed.topic, timeout_s, halt)
        verdict = self._access.gate.check(request)
        if not verdict.may_send:
            return _answer(exposed, verdict)
        remaining_s = max(0.5, timeout_s - (time.monotonic() - started_s))
        response = call_service(
            self._access.traffic, interface.ros_type, exposed.topic, request.messages[0], remaining_s, halt
        )
        return _answer(exposed, verdict, interface.response.decode(response), time.monotonic() - started_s)


def await_service(traffic: Traffic, ros_type: Any, name: str, timeout_s: float, halt: threading.Event) -> None:
    """Wait until somebody serves it. Raises NotReadyError, and StateError when `halt` is set."""
    link = traffic.link()

    def look() -> bool:
        _check(halt)
        return link.is_service_ready(ros_type, name)

    if not Changes().wait_for(look, timeout_s):
        raise NotReadyError(
            f"Nobody serves {name} within {timeout_s:g} s: nothing was sent.", hint="Start what serves it."
        )


def call_service(
    traffic: Traffic, ros_type: Any, name: str, message: Any, timeout_s: float, halt: threading.Event
) -> Any:
    """Send the request and wait for the response. Raises NotReadyError, and StateError when `halt` is set."""
    changes = Changes()
    call = traffic.link().call(ros_type, name, message, changes.notify)

    def look() -> bool:
        _check(halt)
        return call.done

    try:
        answered = changes.wait_for(look, timeout_s)
    except StateError:
        call.abandon()
        raise
    if not answered or call.response is None:
        call.abandon()
        raise NotReadyError(
            f"{name} did not answer within {timeout_s:g} s; the request was sent and may still be carried out."
        )
    return call.response


def _check(halt: threading.Event) -> None:
    if halt.is_set():
        raise StateError("The call was cancelled.")


def _answer(exposed: Exposed, verdict: Verdict, response: Any = None, took_s: float = 0.0) -> Answer:
    structured: dict[str, Any] = {
        "robot": exposed.robot,
        "service": exposed.topic,
        "type": exposed.endpoint.type,
        "took_s": round(took_s, 6),
        **verdict_fields(verdict),
    }
    if response is not None:
        structured["response"] = response
    return Answer(structured=structured)
