"""Approval of a call by a person, where configured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rn_standard.tasks.options import TaskOptions
from roboneuron import CallContext, RefusedError, foreign
from roboneuron.feature import (
    Answer,
    CallPhase,
    IncomingCall,
    Interceptor,
    Proceed,
    StillReason,
)

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
        self._tools = frozenset(options.approval) & subjects.keys()

    def interceptors(self) -> list[Interceptor]:
        """The step of the configured tools; none if there are none."""
        step = Interceptor(
            name="approval", phase=CallPhase.CONFIRMATION, around=self._ask, tools=self._tools
        )
        return [step] if self._tools else []

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """Why nothing moves for clients of the configured roles before a person agrees."""
        if asker is None or asker.role not in self._options.approval_roles or not self._tools:
            return ()
        return (self._reason(" and ".join(sorted(self._tools)), asker.role),)

    def _reason(self, tools: str, role: str) -> StillReason:
        return StillReason(
            rank="person",
            rule="person",
            message=f"A person must approve {tools} for the role {role!r}.",
            hint="Call it by a client that supports elicitation, which asks the person, or with a "
            "role that is not in approval_roles of [tasks].",
        )

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
            raise self._reason(call.name, role).refusal(" This client cannot ask one.")
        if not agreed:
            raise RefusedError(f"A person did not approve {call.name}.", rule="person")
        return await proceed(call)
