"""Client of a managed node's standard lifecycle and parameter services, with bounded calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from roboneuron.errors import NotReadyError
from roboneuron.supervisor.changes import Changes

if TYPE_CHECKING:
    from roboneuron.ros.link import Call, RosLink


_TRANSITIONS = {
    "configure": (1, "unconfigured", "inactive"),
    "activate": (3, "inactive", "active"),
    "deactivate": (4, "active", "inactive"),
}
"""Id of each transition, and the states before and after it. Source:
lifecycle_msgs/msg/Transition.
"""
_STATE_CALL_S = 1.0
"""Timeout of one `get_state` call; a node answers in milliseconds or not at all."""
_LOST_S = 1.0
"""A request without an answer after this time counts as lost if the node answers others and is
still in the previous state.
"""


class NodeClient:
    """Drive one managed node, and set its parameters.

    Args:
        node: absolute name of the node.
        announce: sends the node's process the digest of a request before the request itself.
        check: called while waiting for a transition; raises to give up (the process died, the start
            was cancelled).
    """

    def __init__(
        self,
        link: RosLink,
        changes: Changes,
        node: str,
        announce: Callable[[bytes], None],
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._announce = announce
        self._link = link
        self._changes = changes
        self._node = node
        self._check = check

    def wait_until_served(self, timeout_s: float) -> bool:
        """Wait until the node serves its lifecycle services; True if `get_state` answered and
        `change_state` was discovered in time.

        A killed node stays in the graph for some seconds, so only an answer proves that this one is
        alive.

        Args:
            timeout_s: for both [s].
        """
        from lifecycle_msgs.srv import ChangeState, GetState  # heavy

        deadline_s = time.monotonic() + timeout_s

        def served() -> bool:
            # In this order, which discovery keeps: a node that answers `get_state` can also answer
            # `change_state`.
            return self._link.is_service_ready(
                ChangeState, self._name("change_state")
            ) and self._link.is_service_ready(GetState, self._name("get_state"))

        while (remaining_s := deadline_s - time.monotonic()) > 0:
            if not self._changes.wait_for(served, remaining_s, self._check):
                return False
            if self.state(min(_STATE_CALL_S, remaining_s)) is not None:
                return True
        return False

    def state(self, timeout_s: float = _STATE_CALL_S) -> str | None:
        """Label of the primary state, or None if no answer came in time.

        Args:
            timeout_s: bound on the answer [s].
        """
        from lifecycle_msgs.srv import GetState  # heavy

        call = self._link.call(
            GetState, self._name("get_state"), GetState.Request(), self._changes.notify
        )
        if not self._changes.wait_for(call.done, timeout_s, self._check):
            call.cancel()
            return None
        return str(call.result().current_state.label)

    def transition(self, name: str, timeout_s: float) -> bool | None:
        """Request "configure", "activate" or "deactivate".

        Returns True if the node made it, False if it refused, None without an answer in time.

        Args:
            name: name of the transition.
            timeout_s: bound on the answer.
        """
        from lifecycle_msgs.msg import Transition  # heavy
        from lifecycle_msgs.srv import ChangeState  # heavy

        from roboneuron.modules.requests import digest_of  # heavy

        number, before, after = _TRANSITIONS[name]
        request = ChangeState.Request(transition=Transition(id=number, label=name))
        deadline_s = time.monotonic() + timeout_s
        calls: list[Call] = []
        made: bool | None = None
        while made is None and (remaining_s := deadline_s - time.monotonic()) > 0:
            state = self.state(min(_STATE_CALL_S, remaining_s)) if calls else before
            if state == after:
                made = True  # the answer was lost
                break
            # A killed node stays in the graph for some seconds: a request may have gone to it
            # alone.
            if state == before:
                self._announce(digest_of(request))
                calls.append(
                    self._link.call(
                        ChangeState, self._name("change_state"), request, self._changes.notify
                    )
                )
            self._changes.wait_for(
                lambda: _made(calls) is not None, min(_LOST_S, remaining_s), self._check
            )
            made = _made(calls)
        for call in calls:
            if not call.done():
                call.cancel()
        return made

    def send(self, values: Mapping[str, str | int]) -> Call:
        """Request a change of parameters without waiting for the answer; see `finish`.

        Args:
            values: values by name, all in one request.

        Raises:
            NotReadyError: the process does not read announcements.
        """
        from rcl_interfaces.srv import SetParameters  # heavy

        from roboneuron.modules.requests import digest_of, parameters_request  # heavy

        request = parameters_request(values)
        self._announce(digest_of(request))
        return self._link.call(
            SetParameters, self._name("set_parameters"), request, self._changes.notify
        )

    def finish(
        self, call: Call, timeout_s: float, check: Callable[[], object] = lambda: None
    ) -> str:
        """Wait for the answer; return the node's reason for a refusal, empty if it accepted.

        Args:
            call: returned by `send`.
            timeout_s: bound on the answer [s].
            check: called while waiting; raises to give up.

        Raises:
            NotReadyError: no answer in time.
        """
        if not self._changes.wait_for(call.done, timeout_s, check):
            call.cancel()
            raise NotReadyError(
                f"{self._node} did not take its parameters within {timeout_s:.2g} s.",
                hint="It may hang: see loop_age_s in get_status.",
            )
        return "; ".join(result.reason for result in call.result().results if not result.successful)

    def set(
        self,
        values: Mapping[str, str | int],
        timeout_s: float,
        check: Callable[[], object] = lambda: None,
    ) -> str:
        """Wait until the service is discovered, then `send` and `finish`.

        Raises:
            NotReadyError: the service was not discovered in time, or as `send` and `finish`.
        """
        from rcl_interfaces.srv import SetParameters  # heavy

        name = self._name("set_parameters")
        if not self._changes.wait_for(
            lambda: self._link.is_service_ready(SetParameters, name), timeout_s, check
        ):
            raise NotReadyError(f"The service {name} was not found within {timeout_s:g} s.")
        return self.finish(self.send(values), timeout_s, check)

    def _name(self, service: str) -> str:
        return f"{self._node}/{service}"


def _made(calls: Sequence[Call]) -> bool | None:
    """True if the node made the transition; None before the first answer.

    Answers come in the order of the requests: the first answer is a refusal only if the node made
    none of them.
    """
    answers = [bool(call.result().success) for call in calls if call.done()]
    return any(answers) if answers else None
