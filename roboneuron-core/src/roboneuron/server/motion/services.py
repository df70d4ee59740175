"""Requests to ROS services: through the gate where they may move something, and plainly where they only read."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from roboneuron.errors import InternalError, NotReadyError, StateError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.server.motion.access import Access
from roboneuron.server.motion.exposed import Exposed
from roboneuron.supervisor.changes import Changes

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink


_READING = ("GetParameters", "ListParameters", "DescribeParameters")


@dataclass(frozen=True, kw_only=True, slots=True)
class Response:
    """The answer of a service; `message` is None when the gate's `verdict` let nothing through."""

    verdict: Verdict
    message: Any = None
    took_s: float = 0.0


def call(access: Access, exposed: Exposed, request: GateRequest, timeout_s: float, halt: threading.Event) -> Response:
    """Send the request to the service of an endpoint and wait for the answer; blocks.

    Raises:
        RefusedError: the gate, or somebody else moves the robot.
        NotReadyError: nobody serves it, or no answer came.
        StateError: cancelled.
    """
    if exposed.endpoint.joint_limited:
        request = replace(request, joints=access.traffic.joints(exposed, min(timeout_s, 2.0)))
    if request.dry_run:
        return Response(verdict=access.ask(exposed, request))
    access.arbiter.check_free(exposed)
    started_s = time.monotonic()
    _await_service(access.traffic.link(), exposed.ros_type, exposed.topic, timeout_s, halt)
    verdict = access.gate.check(request)
    if not verdict.may_send:
        return Response(verdict=verdict)
    remaining_s = max(0.5, timeout_s - (time.monotonic() - started_s))
    message = _call_service(
        access.traffic.link(), exposed.ros_type, exposed.topic, request.messages[0], remaining_s, halt
    )
    return Response(verdict=verdict, message=message, took_s=time.monotonic() - started_s)


def read_parameters(
    access: Access, ros_type: Any, name: str, message: Any, timeout_s: float, halt: threading.Event
) -> Any:
    """Ask a parameter service that changes nothing: wait for it, send the request, return the response; blocks.

    Raises:
        InternalError: this type is none of those.
        NotReadyError: nobody serves it, or no answer came.
        StateError: cancelled.
    """
    if not ros_type.__module__.startswith("rcl_interfaces.") or ros_type.__name__ not in _READING:
        raise InternalError(f"{ros_type.__name__} is no service that only reads parameters.")
    started_s = time.monotonic()
    _await_service(access.traffic.link(), ros_type, name, timeout_s, halt)
    remaining_s = max(0.5, timeout_s - (time.monotonic() - started_s))
    return _call_service(access.traffic.link(), ros_type, name, message, remaining_s, halt)


def _await_service(link: RosLink, ros_type: Any, name: str, timeout_s: float, halt: threading.Event) -> None:
    """Wait until somebody serves it. Raises NotReadyError, and StateError when `halt` is set."""

    def look() -> bool:
        _check(halt)
        return link.is_service_ready(ros_type, name)

    if not Changes().wait_for(look, timeout_s):
        raise NotReadyError(
            f"Nobody serves {name} within {timeout_s:g} s: nothing was sent.", hint="Start what serves it."
        )


def _call_service(
    link: RosLink, ros_type: Any, name: str, message: Any, timeout_s: float, halt: threading.Event
) -> Any:
    """Send the request and wait for the response. Raises NotReadyError, and StateError when `halt` is set."""
    changes = Changes()
    pending = link.call(ros_type, name, message, changes.notify)

    def look() -> bool:
        _check(halt)
        return pending.done

    try:
        answered = changes.wait_for(look, timeout_s)
    except StateError:
        pending.abandon()
        raise
    if not answered or pending.response is None:
        pending.abandon()
        raise NotReadyError(
            f"{name} did not answer within {timeout_s:g} s; the request was sent and may still be carried out."
        )
    return pending.response


def _check(halt: threading.Event) -> None:
    if halt.is_set():
        raise StateError("The call was cancelled.")
