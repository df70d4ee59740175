"""Calls to the services of endpoints: wait for a server, send through the gate, wait for the
answer.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import Any

from roboneuron.errors import NotReadyError, StateError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate
from roboneuron.server.verdict import Verdict

_LOOK_S = 0.05
"""Polling period, which bounds the end of a cancelled call."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Response:
    """Answer of a service; `message` is None if the gate's `verdict` refused the request."""

    verdict: Verdict
    message: Any = None
    took_s: float = 0.0


def call(
    gate: MotionGate,
    exposed: ExposedEndpoint,
    request: GateRequest,
    timeout_s: float,
    halt: threading.Event,
) -> Response:
    """Send the request to the service of an endpoint and wait for the answer; blocks.

    Raises:
        RefusedError: the gate refuses, or another client moves the robot.
        NotReadyError: there is no server, or no answer came.
        StateError: cancelled.
    """
    if exposed.endpoint.joint_limited:
        request = replace(request, joints=gate.joints(exposed, min(timeout_s, 2.0)))
    if request.simulated:
        return Response(verdict=gate.ask(exposed, request))
    if exposed.endpoint.kind != "read":
        gate.check_free(exposed)
    started_s = time.monotonic()
    _check(halt)
    while not gate.is_served(exposed):
        if time.monotonic() - started_s >= timeout_s:
            raise NotReadyError(
                f"{exposed.topic} had no server within {timeout_s:g} s: nothing was sent.",
                hint="Start what serves it.",
            )
        halt.wait(_LOOK_S)
        _check(halt)
    answered = threading.Event()
    verdict, pending = gate.send_request(exposed, request, answered.set)
    if pending is None:
        return Response(verdict=verdict)
    remaining_s = max(0.5, timeout_s - (time.monotonic() - started_s))
    deadline_s = time.monotonic() + remaining_s
    try:
        while not answered.wait(_LOOK_S) and time.monotonic() < deadline_s:
            _check(halt)
    except StateError:
        pending.cancel()
        raise
    if not answered.is_set() or pending.result() is None:
        pending.cancel()
        raise NotReadyError(
            f"{exposed.topic} did not answer within {remaining_s:g} s; the request was sent and "
            "may still be carried "
            "out."
        )
    return Response(verdict=verdict, message=pending.result(), took_s=time.monotonic() - started_s)


def _check(halt: threading.Event) -> None:
    if halt.is_set():
        raise StateError("The call was cancelled.")
