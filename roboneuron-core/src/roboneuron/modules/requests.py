"""Requests that only a module's own server may make: lifecycle transitions, and setting parameters.

ROS does not tell who has sent a request, and anybody on the graph may send one. The server
therefore announces each of its own over the module's stdin, a pipe that nobody else holds, by a
digest of its content. What was not announced is refused, counted and reported with the names of the
nodes that could have sent it. A foreign node that repeats an announced request before the server's
own arrives has done what the server wanted.

The announcement lies in the pipe before the request is sent. Before it is judged the pipe is read
to its present end, by the thread that judges: no thread has to be given the processor in time for
that, and nothing has to be waited for.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter

from roboneuron.modules.settings import FOREIGN_REQUEST
from roboneuron.modules.status import StatusWriter

log = logging.getLogger(__name__)
_LOG_PERIOD_S = 1.0
_MOST = 256
_REASON = "only the server of this module may do that; use its tools"


def digest_of_transition(number: int, label: str) -> bytes:
    """Of the request for the transition with that number and label; the node goes by the label if
    there is one.
    """
    return _digest(["change_state", number, label])


def digest_of_parameters(values: Mapping[str, object]) -> bytes:
    """Of the request to set these parameters."""
    return _digest(["set_parameters", dict(values)])


def _digest_of_messages(parameters: Sequence[ParameterMessage]) -> bytes:
    """Empty when a type is none of ParameterType's: rclpy raises there, and the executor would end
    with it.
    """
    try:
        return digest_of_parameters(
            {p.name: Parameter.from_parameter_msg(p).value for p in parameters}
        )
    except ValueError:
        return b""


def parameters_request(values: Mapping[str, str | int]) -> SetParameters.Request:
    """The request itself."""
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return SetParameters.Request(parameters=parameters)


def _digest(content: object) -> bytes:
    text = json.dumps(content, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest().encode()


class Announcements:
    """What the server has announced and the module has not been asked for yet; usable from any
    thread.

    Attributes:
        catch_up: feeds what the server has written until now.
    """

    def __init__(self, catch_up: Callable[[], object] = lambda: None) -> None:
        self.catch_up = catch_up
        self._lock = threading.Lock()
        self._digests: deque[bytes] = deque(maxlen=_MOST)
        self._rest = b""
        self._is_supervised = False

    def feed(self, data: bytes) -> None:
        """Bytes from stdin: a line for each announcement; empty lines are signs of life."""
        with self._lock:
            self._is_supervised = True
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._digests.extend(line for line in lines if line)

    def take(self, digest: bytes) -> bool:
        """Whether that was announced; everything is, to a module without a server."""
        self.catch_up()
        with self._lock:
            if not self._is_supervised:
                return True
            if digest not in self._digests:
                return False
            self._digests.remove(digest)
            return True


class RequestGuard:
    """Stands before a node's services; everything happens on the executor's thread, except
    `Announcements.feed`.
    """

    def __init__(self, node: Node, status: StatusWriter) -> None:
        self.announcements = Announcements()
        self._node = node
        self._status = status
        self._logged_s = -_LOG_PERIOD_S
        for service in node.services:
            if service.srv_type in (ChangeState, SetParameters, SetParametersAtomically):
                self._guard(service)
        node.add_on_set_parameters_callback(_refuse_simulated_time)

    def _guard(self, service: Any) -> None:
        answer = service.callback

        def guarded(request: Any, response: Any) -> Any:
            if isinstance(request, ChangeState.Request):
                asked = request.transition
                what, digest = (
                    f"transition {asked.label or asked.id}",
                    digest_of_transition(asked.id, asked.label),
                )
            else:
                what = f"set {', '.join(p.name for p in request.parameters)}"
                digest = _digest_of_messages(request.parameters)
            if digest and self.announcements.take(digest):
                return answer(request, response)
            self._report(what, service.srv_name)
            refused = SetParametersResult(successful=False, reason=_REASON)
            if isinstance(response, SetParameters.Response):
                response.results = [refused for _ in request.parameters]
            elif isinstance(response, SetParametersAtomically.Response):
                response.result = refused
            return response  # of ChangeState: no success

        service.callback = guarded

    def _report(self, what: str, service: str) -> None:
        self._status.dropped.add(FOREIGN_REQUEST)
        now_s = time.monotonic()
        if now_s - self._logged_s < _LOG_PERIOD_S:
            return
        self._logged_s = now_s
        text = f"{what[:200]!r} was refused; it came from {self._senders(service)}"
        log.warning("A request that is not the server's: %s.", text)
        self._status.set_value(FOREIGN_REQUEST, text)
        self._status.changed.set()

    def _senders(self, service: str) -> str:
        """Nodes other than the server that may call the service."""
        name = self._node.resolve_service_name(service)
        found = self._node.get_publishers_info_by_topic(f"rq{name}Request", no_mangle=True)
        names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in found}
        return (
            " or ".join(sorted(names - {f"/roboneuron_server_{os.getppid()}"}))
            or "a node that has left"
        )


def _refuse_simulated_time(parameters: list[Parameter]) -> SetParametersResult:
    """Nobody stamps by /clock here: ages would be those of another clock."""
    simulated = any(
        parameter.name == "use_sim_time" and parameter.value for parameter in parameters
    )
    return SetParametersResult(
        successful=not simulated, reason="use_sim_time is not supported" if simulated else ""
    )
