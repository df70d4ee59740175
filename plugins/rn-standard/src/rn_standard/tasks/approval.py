"""Approval of a call by a person, where configured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rn_standard.tasks.options import TaskOptions
from roboneuron import RefusedError, foreign
from roboneuron.feature import Answer, CallPhase, IncomingCall, Interceptor, Proceed

_MOST = 2000
Subject = Callable[[Any], tuple[str, str] | None]
"""Return what the robot would do for these arguments, such as "carry out", and with which words of
an agent; None if nobody need be asked. Raises RoboNeuronError for a call that is refused anyway.
"""


class Approval:
    """Asks the user of a client before the configured tools, for the configured roles.

    Args:
        options: names tools and roles.
        subjects: what is asked, by tool.
    """

    def __init__(self, options: TaskOptions, subjects: Mapping[str, Subject]) -> None:
        self._options = options
        self._subjects = subjects

    def interceptors(self) -> list[Interceptor]:
        """The step of the configured tools; none if there are none."""
        tools = frozenset(self._options.approval) & self._subjects.keys()
        step = Interceptor(
            name="approval", phase=CallPhase.CONFIRMATION, around=self._ask, tools=tools
        )
        return [step] if tools else []

    async def _ask(self, call: IncomingCall, proceed: Proceed) -> Answer:
        """Hand on a call that needs no approval, or to which a person agreed.

        Raises:
            RefusedError: the person refused or did not answer, or the client cannot ask.
        """
        role = call.context.role
        subject = None
        if role in self._options.approval_roles:
            subject = self._subjects[call.name](call.parsed)
        if subject is None:
            return await proceed(call)
        doing, words = subject
        agreed = await call.context.ask(f"Let the robot {doing} {foreign.quoted(words, _MOST)}?")
        if agreed is None:
            raise RefusedError(
                f"A person must approve {call.name} for the role {role!r}, and this client "
                "cannot ask one.",
                hint="Use a client that supports elicitation, or a role that is not in "
                "approval_roles of [tasks].",
                rule="person",
            )
        if not agreed:
            raise RefusedError(f"A person did not approve {call.name}.", rule="person")
        return await proceed(call)
