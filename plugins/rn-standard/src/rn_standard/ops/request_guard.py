"""Refuse lifecycle and parameter requests that are not those of a module's own server.

They would undo stops: the parameters `start`, `limits` and `instruction`, and the transition
`activate`. Refusals are counted and reported with the names of the nodes that could have asked. A
foreign node that repeats an announced request before the server's own arrives has done what the
server wanted.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically

if TYPE_CHECKING:
    from roboneuron.node import ModuleHost

log = logging.getLogger(__name__)
_REPORT_PERIOD_S = 1.0
"""A node that asks all the time fills neither the log nor the status."""
_MOST = 256
"""Announcements that wait for their request; requests that never arrive are forgotten in order."""
_REASON = "only the server of this module may do that; use its tools"


def join(host: ModuleHost) -> None:
    """Called in every module process; see `FeatureSpec.on_join`."""
    RequestGuard(host).guard()


class Announcements:
    """What the server has announced and the module has not been asked for yet; usable from any
    thread.
    """

    def __init__(self) -> None:
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
        with self._lock:
            if not self._is_supervised:
                return True
            if digest not in self._digests:
                return False
            self._digests.remove(digest)
            return True


class RequestGuard:
    """Stands before a node's services; everything happens on the executor's thread."""

    def __init__(self, host: ModuleHost) -> None:
        self._host = host
        self._announcements = Announcements()
        host.on_stdin.append(self._announcements.feed)
        self._reported_s = -_REPORT_PERIOD_S

    def guard(self) -> None:
        """Guard the services that the node has now, which are all that lead to transitions and
        parameters.
        """
        for service in self._host.services:
            if service.srv_type in (ChangeState, SetParameters, SetParametersAtomically):
                self._guard(service)
        self._host.add_on_set_parameters_callback(_refuse_simulated_time)

    def _guard(self, service: Any) -> None:
        """Put the question before the service's own callback.

        Args:
            service: rclpy Service; a refusal is an answer too, so that nobody waits for one.
        """
        answer = service.callback

        def guarded(request: Any, response: Any) -> Any:
            # Read to its present end by the thread that judges: no thread has to be given the
            # processor in time for that, and nothing has to be waited for.
            self._host.read_stdin()
            if self._announcements.take(self._host.digest(request)):
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
        now_s = time.monotonic()
        text = ""
        if now_s - self._reported_s >= _REPORT_PERIOD_S:
            self._reported_s = now_s
            text = f"{_described(request)!r} was refused; it came from {self._senders(service)}"
            log.warning("A request that is not the server's: %s.", text)
        self._host.report_foreign_request(text)

    def _senders(self, service: str) -> str:
        """Nodes other than the server that may call the service, by their publishers of requests.

        Source: ROS 2 maps a service to the DDS topics rq/<name>Request and rr/<name>Reply.
        """
        name = self._host.resolve_service_name(service)
        found = self._host.get_publishers_info_by_topic(f"rq{name}Request", no_mangle=True)
        names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in found}
        names.discard(f"/roboneuron_server_{os.getppid()}")
        return " or ".join(sorted(names)) or "a node that has left"


def _described(request: Any) -> str:
    if isinstance(request, ChangeState.Request):
        what = f"transition {request.transition.label or request.transition.id}"
    else:
        what = f"set {', '.join(parameter.name for parameter in request.parameters)}"
    return what[:200]


def _refuse_simulated_time(parameters: list[Any]) -> SetParametersResult:
    """Refuse `use_sim_time`: modules do not stamp by /clock, so that ages would be wrong."""
    for parameter in parameters:
        if parameter.name == "use_sim_time" and parameter.value:
            return SetParametersResult(successful=False, reason="use_sim_time is not supported")
    return SetParametersResult(successful=True)
