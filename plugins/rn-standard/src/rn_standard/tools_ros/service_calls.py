"""Requests to the services of endpoints: wait until somebody serves it, send through the gate, wait
for the answer.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import Any

from roboneuron import NotReadyError, StateError
from roboneuron.feature import Changes, ExposedEndpoint, GateRequest, MotionGate, Verdict


@dataclass(frozen=True, kw_only=True, slots=True)
class Response:
    """The answer of a service; `message` is None when the gate's `verdict` let nothing through."""

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
        RefusedError: the gate, or somebody else moves the robot.
        NotReadyError: nobody serves it, or no answer came.
        StateError: cancelled.
    """
    if exposed.endpoint.joint_limited:
        request = replace(request, joints=gate.joints(exposed, min(timeout_s, 2.0)))
    if request.dry_run:
        return Response(verdict=gate.ask(exposed, request))
    if exposed.endpoint.kind != "read":
        gate.check_free(exposed)
    started_s = time.monotonic()
    changes = Changes()

    def is_served() -> bool:
        _check(halt)
        return gate.is_served(exposed)

    if not changes.wait_for(is_served, timeout_s):
        raise NotReadyError(
            f"{exposed.topic} had no server within {timeout_s:g} s: nothing was sent.",
            hint="Start what serves it.",
        )
    verdict, pending = gate.send_request(exposed, request, changes.notify)
    if pending is None:
        return Response(verdict=verdict)

    def is_answered() -> bool:
        _check(halt)
        return bool(pending.done())

    remaining_s = max(0.5, timeout_s - (time.monotonic() - started_s))
    try:
        answered = changes.wait_for(is_answered, remaining_s)
    except StateError:
        pending.cancel()
        raise
    if not answered or pending.result() is None:
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
