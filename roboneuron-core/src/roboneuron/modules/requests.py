"""Authentication of requests that only a module's own server may make: lifecycle transitions and
parameters.

ROS does not identify the sender of a request, and any node on the graph may send one. The server
therefore announces each of its requests over the module's stdin, a pipe that only the server can
write to, by a digest of the content. A request without an announcement is refused, counted and
reported with the names of the nodes that could have sent it. If a foreign node repeats an announced
request before the server's own arrives, the effect is the one the server intended.

The server writes the announcement before it sends the request. The thread that checks a request
first reads the pipe to its present end, so that the check depends on no other thread and on no
wait.
"""

from __future__ import annotations

import hashlib
import json
import logging
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
from roboneuron.ros.graph import foreign_names

log = logging.getLogger(__name__)
_LOG_PERIOD_S = 1.0
"""Rate limit of the log, for a node that keeps sending requests."""
_MOST = 256
"""Announcements kept for requests that have not arrived; the oldest are discarded first."""
_REASON = "only the server of this module may do that; use its tools"


def digest_of(request: object) -> bytes:
    """Return the SHA-256, in hexadecimal, of a request and its content.

    The digest is the same in the server and in the module, whatever their interpreters.

    Args:
        request: request of a service.
    """
    return (
        hashlib.sha256(json.dumps(request, default=_contents, sort_keys=True).encode())
        .hexdigest()
        .encode()
    )


def _contents(value: Any) -> object:
    """Return the fields of a message, or the elements of an array; not its `repr`, which differs
    between distributions of ROS.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: getattr(value, name) for name in value.get_fields_and_field_types()}
    return [str(element) for element in value]


def parameters_request(values: Mapping[str, str | int]) -> SetParameters.Request:
    """Return the request that sets these parameters."""
    return SetParameters.Request(
        parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
    )


class Announcements:
    """Announcements of the server whose requests have not arrived yet; usable from any thread.

    Attributes:
        catch_up: feeds everything that the server has written so far.
    """

    def __init__(self, catch_up: Callable[[], object] = lambda: None) -> None:
        """Args:
        catch_up: see `catch_up` above.
        """
        self.catch_up = catch_up
        # `feed` and `take` come on different threads; not reentrant, so `take` catches up first
        self._lock = threading.Lock()
        self._digests: deque[bytes] = deque(maxlen=_MOST)
        self._rest = b""
        self._is_supervised = False

    def feed(self, data: bytes) -> None:
        """Process data read from stdin.

        Args:
            data: a line for each announcement, empty lines for signs of life; a line may be cut
                anywhere; its rest comes with the next call.
        """
        with self._lock:
            self._is_supervised = True
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._digests.extend(line for line in lines if line)

    def take(self, digest: bytes) -> bool:
        """Consume an announcement; True if the request was announced. Each announcement counts
        once.

        For a module that was started by hand, without a server, every request counts as announced.

        Args:
            digest: digest of the request.
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
    """Access check in front of a node's services; runs on the executor's thread, except
    `Announcements.feed`.

    It belongs to the core and to every module process, because the services it guards undo stops:
    the parameters `start`, `limits` and `instruction`, and the transition `activate`.

    Attributes:
        announcements: those of the server.
    """

    def __init__(self, node: Node, status: StatusWriter) -> None:
        """Args:
        node: its present services are guarded; later ones are not.
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
        """Add the check in front of the service's own callback.

        Args:
            service: rclpy Service; a refusal is sent as a response, so that the caller does not
                time out.
        """
        answer = service.callback

        def guarded(request: Any, response: Any) -> Any:
            if self.announcements.take(digest_of(request)):
                return answer(request, response)
            self._report(request, service.srv_name)
            # in the fields of the service, so that the caller's own library shows the reason
            refused = SetParametersResult(successful=False, reason=_REASON)
            if isinstance(response, SetParameters.Response):
                response.results = [refused for _ in request.parameters]
            elif isinstance(response, SetParametersAtomically.Response):
                response.result = refused
            return response  # of ChangeState: no success

        service.callback = guarded

    def _report(self, request: Any, service: str) -> None:
        """Count a refusal; log the request and its possible senders at most once a second."""
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
        return (
            " or ".join(foreign_names(found))
            or "a node whose name is not known: it has just come, or has left"
        )


def _refuse_simulated_time(parameters: list[Parameter]) -> SetParametersResult:
    """Refuse `use_sim_time`: ages computed by /clock would not match stamps of the system clock."""
    simulated = any(
        parameter.name == "use_sim_time" and parameter.value for parameter in parameters
    )
    return SetParametersResult(
        successful=not simulated, reason="use_sim_time is not supported" if simulated else ""
    )
