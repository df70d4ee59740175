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
from collections.abc import Callable, Mapping
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter

from roboneuron.modules.settings import FOREIGN_REQUEST
from roboneuron.modules.status import StatusWriter

log = logging.getLogger(__name__)
_LOG_PERIOD_S = 1.0
"""A node that asks all the time fills neither the log nor the status."""
_MOST = 256
"""Announcements that wait for their request; requests that never arrive are forgotten in order."""
_REASON = "only the server of this module may do that; use its tools"


def digest_of(request: object) -> bytes:
    """SHA-256, in hexadecimal, of a request with all that it asks for.

    It is the same in the server and in the module, whatever their interpreters.

    Args:
        request: of a service.
    """
    text = json.dumps(request, default=_contents, sort_keys=True).encode()
    return hashlib.sha256(text).hexdigest().encode()


def _contents(value: Any) -> object:
    """Fields of a message, or elements of an array: not its `repr`, which differs between
    distributions of ROS.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: getattr(value, name) for name in value.get_fields_and_field_types()}
    return [str(element) for element in value]


def parameters_request(values: Mapping[str, str | int]) -> SetParameters.Request:
    """The request to set these parameters."""
    return SetParameters.Request(
        parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
    )


class Announcements:
    """What the server has announced and the module has not been asked for yet; usable from any
    thread.

    Attributes:
        catch_up: feeds what the server has written until now.
    """

    def __init__(self, catch_up: Callable[[], object] = lambda: None) -> None:
        """Args:
        catch_up: see `catch_up` above.
        """
        self.catch_up = catch_up
        self._lock = threading.Lock()
        self._digests: deque[bytes] = deque(maxlen=_MOST)
        self._rest = b""
        self._is_supervised = False

    def feed(self, data: bytes) -> None:
        """Take what was read from stdin.

        Args:
            data: a line for each announcement, empty lines for signs of life; a line may be cut
                anywhere, its rest comes with the next call.
        """
        with self._lock:
            self._is_supervised = True
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._digests.extend(line for line in lines if line)

    def take(self, digest: bytes) -> bool:
        """Whether a request was announced, and is not any more; each announcement counts once.

        To a module without a server, as one is started by hand, everything counts as announced.

        Args:
            digest: of the request.
        """
        # Without the lock: this calls `feed`, on this thread.
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

    It belongs to the core and to every module process, because the services it guards undo stops:
    the parameters `start`, `limits` and `instruction`, and the transition `activate`.

    Attributes:
        announcements: of the server.
    """

    def __init__(self, node: Node, status: StatusWriter) -> None:
        """Args:
        node: whose services of today are guarded; later ones are not.
        status: where refusals are counted.
        """
        self.announcements = Announcements()
        self._node = node
        self._status = status
        self._logged_s = -_LOG_PERIOD_S
        for service in node.services:
            if service.srv_type in (ChangeState, SetParameters, SetParametersAtomically):
                self._guard(service)
        node.add_on_set_parameters_callback(_refuse_simulated_time)

    def _guard(self, service: Any) -> None:
        """Put the question before the service's own callback.

        Args:
            service: rclpy Service; a refusal is an answer too, so that nobody waits for one.
        """
        answer = service.callback

        def guarded(request: Any, response: Any) -> Any:
            if self.announcements.take(digest_of(request)):
                return answer(request, response)
            self._report(request, service.srv_name)
            # in the words of the service, so that the caller's own library tells the reason
            refused = SetParametersResult(successful=False, reason=_REASON)
            if isinstance(response, SetParameters.Response):
                response.results = [refused for _ in request.parameters]
            elif isinstance(response, SetParametersAtomically.Response):
                response.result = refused
            return response  # of ChangeState: no success

        service.callback = guarded

    def _report(self, request: Any, service: str) -> None:
        """Count a refusal; say at most once a second in words what was asked for and by whom."""
        self._status.drop(FOREIGN_REQUEST)
        now_s = time.monotonic()
        if now_s - self._logged_s < _LOG_PERIOD_S:
            return
        self._logged_s = now_s
        if isinstance(request, ChangeState.Request):
            what = f"transition {request.transition.label or request.transition.id}"
        else:
            what = f"set {', '.join(p.name for p in request.parameters)}"
        text = f"{what[:200]!r} was refused; it came from {self._senders(service)}"
        log.warning("A request that is not the server's: %s.", text)
        self._status.set_value(FOREIGN_REQUEST, text)
        self._status.changed.set()

    def _senders(self, service: str) -> str:
        """Nodes other than the server that may call the service, by their publishers of requests.

        Source: ROS 2 maps a service to the DDS topics rq/<name>Request and rr/<name>Reply.
        """
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
