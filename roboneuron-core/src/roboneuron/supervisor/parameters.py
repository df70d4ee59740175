"""ROS parameters of a module, set with a bound on the time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from roboneuron.errors import NotReadyError
from roboneuron.supervisor.changes import Changes

if TYPE_CHECKING:
    from roboneuron.ros.link import Call, RosLink


def _request(values: Mapping[str, str | int]) -> Any:
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # heavy
    from rcl_interfaces.srv import SetParameters  # heavy

    def value(of: str | int) -> Any:
        if isinstance(of, str):
            return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=of)
        return ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=int(of))

    return SetParameters.Request(parameters=[Parameter(name=name, value=value(of)) for name, of in values.items()])


class ParameterClient:
    """Sets parameters of one node.

    Args:
        node: its absolute name.
        announce: tells the node's process the digest of a request before it is sent.
    """

    def __init__(self, link: RosLink, changes: Changes, node: str, announce: Callable[[bytes], None]) -> None:
        self._announce = announce
        self._link = link
        self._changes = changes
        self._node = node

    def find(self, timeout_s: float, check: Callable[[], object] = lambda: None) -> None:
        """Wait until its service is known.

        Args:
            check: called while waiting; raises to give up.

        Raises:
            NotReadyError: it was not found in time.
        """
        from rcl_interfaces.srv import SetParameters  # heavy

        name = f"{self._node}/set_parameters"
        if not self._changes.wait_for(lambda: self._link.is_service_ready(SetParameters, name), timeout_s, check):
            raise NotReadyError(f"The service {name} was not found within {timeout_s:g} s.")

    def send(self, values: Mapping[str, str | int]) -> Call:
        """Request the change without waiting for the answer."""
        from rcl_interfaces.srv import SetParameters  # heavy

        from roboneuron.modules.requests import digest_of_parameters  # heavy

        self._announce(digest_of_parameters(values))
        return self._link.call(SetParameters, f"{self._node}/set_parameters", _request(values), self._changes.notify)

    def finish(self, call: Call, timeout_s: float, check: Callable[[], object] = lambda: None) -> str:
        """Wait for the answer; returns why the node refused, empty when it took the values.

        Args:
            check: called while waiting; raises to give up.

        Raises:
            NotReadyError: no answer in time.
        """
        if not self._changes.wait_for(lambda: call.done, timeout_s, check):
            call.abandon()
            raise NotReadyError(
                f"{self._node} did not take its parameters within {timeout_s:.2g} s.",
                hint="It may hang: see loop_age_s in get_status.",
            )
        refused = [result.reason for result in call.response.results if not result.successful]
        return "; ".join(refused)

    def set(self, values: Mapping[str, str | int], timeout_s: float, check: Callable[[], object] = lambda: None) -> str:
        """Find, send and finish."""
        self.find(timeout_s, check)
        return self.finish(self.send(values), timeout_s, check)
