"""The standard lifecycle and parameter services of a managed node, called with a bound on the
time.
"""

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
"""Number of each, and the states before and after it. Source: lifecycle_msgs/msg/Transition."""
_STATE_CALL_S = 1.0
"""Bound on one question for the state; a node answers in milliseconds or not at all."""
_LOST_S = 1.0
"""A request that is not answered by then, though the node answers others and is where it was, did
not reach it.
"""


class NodeClient:
    """Drives one managed node, and sets its parameters.

    Args:
        node: its absolute name.
        announce: tells the node's process the digest of a request before it is sent.
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
        """Whether `get_state` answered and `change_state` was discovered within `timeout_s`.

        A node that was killed stays in the graph for some seconds, so only an answer proves that
        this one serves.

        Args:
            timeout_s: for both [s].
        """
        from lifecycle_msgs.srv import ChangeState, GetState  # heavy

        deadline_s = time.monotonic() + timeout_s

        def served() -> bool:
            # In this order: discovery keeps it, so a node that answers `get_state` can also answer
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
        """Label of the primary state, or None when nobody answered in time.

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

        Returns whether the node made it, or None when it did not answer in time.

        Args:
            name: of the transition.
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
            # One that was killed is in the graph for some seconds more: a request may have gone to
            # it alone.
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
            values: by name; all of one request.

        Raises:
            NotReadyError: the process does not read that a request is coming.
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
        """Wait for the answer; returns why the node refused, empty when it took the values.

        Args:
            call: of `send`.
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
        """Wait until the service is known; then `send` and `finish`.

        Raises:
            NotReadyError: the service was not found in time, or as these.
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
    """Whether the node made the transition; None before the first answer.

    Answers come in the order in which the node follows requests: a refusal comes first only when
    none was followed.
    """
    answers = [bool(call.result().success) for call in calls if call.done()]
    return any(answers) if answers else None
