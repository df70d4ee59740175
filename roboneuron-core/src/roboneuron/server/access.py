"""Who calls, and what a role may call: the only place where roles and tools meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from roboneuron.errors import RefusedError
from roboneuron.gate.request import ADMIN, OPERATOR, VIEWER, has_role
from roboneuron.server.tool import CallContext, DerivedTool, Tool

HOLDER_KEY = "roboneuron.holder"
"""Where the HTTP border leaves the Holder in the ASGI scope of a request."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as the transport knows it.

    Attributes:
        who: for the audit and the log.
        role: one of ROLES; anything else has no rights.
    """

    who: str
    role: str


LOCAL_AGENT = Holder(who="agent on stdio", role=ADMIN)
"""The client of a stdio server: whoever started the server, so it has every role."""
LOCAL_PROCESS = Holder(who="local HTTP client", role=ADMIN)
"""A client of a server on loopback that asks for no token: anybody on this machine, who could start one as well."""
NOBODY = Holder(who="unknown", role="")


def holder_of(request: Any) -> Holder:
    """Who sent a request; None is stdio. A request that the border has not looked at has no rights."""
    if request is None:
        return LOCAL_AGENT
    holder = request.scope.get(HOLDER_KEY)
    return holder if isinstance(holder, Holder) else NOBODY


def is_local(who: str) -> bool:
    """Whether that client was let in without a token; no token can have such a name."""
    return who in (LOCAL_AGENT.who, LOCAL_PROCESS.who)


def least_role(tool: Tool[Any] | DerivedTool) -> str:
    """The least role that may call a tool."""
    return tool.role or (VIEWER if tool.read_only else OPERATOR)


def may_call(role: str, tool: Tool[Any] | DerivedTool) -> bool:
    """Whether a role may call a tool."""
    return has_role(role, least_role(tool))


def check_role(tool: Tool[Any] | DerivedTool, context: CallContext) -> None:
    """Refuse a tool that the caller may not call.

    Raises:
        RefusedError: names the roles.
    """
    if not may_call(context.role, tool):
        raise RefusedError(
            f"{tool.name} needs the role {least_role(tool)!r}; {context.who} has {context.role or 'none'!r}.",
            hint="Use a token with that role, or ask a person who has one.",
        )
