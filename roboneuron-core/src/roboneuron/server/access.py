"""Who calls, and what a role may call."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import ADMIN, OPERATOR, VIEWER, has_role
from roboneuron.server.tool import CallContext, Tool

HOLDER_KEY = "roboneuron.holder"
"""Where a transport of a feature leaves the Holder in the scope of a request."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as the transport knows it.

    Attributes:
        who: for the audit and the log.
        role: one of ROLES; anything else has no rights.
        client: which of several clients without a token; empty for others.
        watched: calls a listener when the connection of this request is lost within the block, or
            was before; None where that cancels the call, as on stdio.
    """

    who: str
    role: str
    client: str = ""
    watched: Callable[[Callable[[], object]], AbstractContextManager[None]] | None = None


LOCAL_AGENT = Holder(who="agent on stdio", role=ADMIN)
"""The client of a stdio server: whoever started the server, so it has every role."""
LOCAL_PROCESS = Holder(who="local HTTP client", role=ADMIN)
"""A client of a server on loopback that asks for no token: anybody on this machine, who could start
one as well.
"""
NOBODY = Holder(who="unknown", role="")


def holder_of(request: Any) -> Holder:
    """Who sent a request; None is stdio. A request without a Holder has no rights."""
    if request is None:
        return LOCAL_AGENT
    holder = request.scope.get(HOLDER_KEY)
    return holder if isinstance(holder, Holder) else NOBODY


def is_local(who: str) -> bool:
    """Whether that client was let in without a token; no token can have such a name."""
    return who == LOCAL_AGENT.who or who.startswith(LOCAL_PROCESS.who)


def least_role(tool: Tool[Any]) -> str:
    """The least role that may call a tool."""
    return tool.role or (VIEWER if tool.read_only else OPERATOR)


def may_call(role: str, tool: Tool[Any]) -> bool:
    """Whether a role may call a tool."""
    return has_role(role, least_role(tool))


def check_role(tool: Tool[Any], context: CallContext) -> None:
    """Refuse a tool that the caller may not call.

    Raises:
        RefusedError: names the roles.
    """
    if not may_call(context.role, tool):
        raise RefusedError(
            f"{tool.name} needs the role {least_role(tool)!r}; {context.who} has "
            f"{context.role or 'none'!r}.",
            hint="Use a token with that role, or ask a person who has one.",
        )
