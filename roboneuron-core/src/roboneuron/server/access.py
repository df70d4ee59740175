"""Who calls, and what a role may call."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import ADMIN, OPERATOR, VIEWER, has_role
from roboneuron.server.tool import CallContext, Tool

HOLDER_KEY = "roboneuron.holder"
"""Where a transport of a feature leaves the Holder in the scope of a request."""
CONNECTION_KEY = "roboneuron.connection"
"""Where it leaves the WatchedConnection of a request, if a call outlives the loss of its connection."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as the transport knows it.

    Attributes:
        who: for the audit and the log.
        role: one of ROLES; anything else has no rights.
        client: which of several clients without a token; empty for others.
    """

    who: str
    role: str
    client: str = ""


LOCAL_AGENT = Holder(who="agent on stdio", role=ADMIN)
"""The client of a stdio server: whoever started the server, so it has every role."""
LOCAL_PROCESS = Holder(who="local HTTP client", role=ADMIN)
"""A client of a server on loopback that asks for no token: anybody on this machine, who could start one as well."""
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


class WatchedConnection(Protocol):
    """The connection that a request came on."""

    def watched(self, listener: Callable[[], object]) -> AbstractContextManager[None]:
        """Call `listener` when the connection is lost within the block, or was before."""
        ...


def watching(request: Any, listener: Callable[[], object] | None) -> AbstractContextManager[None]:
    """Call `listener` when the connection of a request is lost; stdio has none, its end cancels the call."""
    connection: WatchedConnection | None = request.scope.get(CONNECTION_KEY) if request is not None else None
    return nullcontext() if listener is None or connection is None else connection.watched(listener)


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
            f"{tool.name} needs the role {least_role(tool)!r}; {context.who} has {context.role or 'none'!r}.",
            hint="Use a token with that role, or ask a person who has one.",
        )
