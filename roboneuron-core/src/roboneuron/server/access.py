"""Who calls, over which transport, and what a role may call."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import ADMIN, OPERATOR, VIEWER, has_role
from roboneuron.server.tool import CallContext, Tool

if TYPE_CHECKING:
    from anyio import Event

_LOCAL_CLIENT = "local HTTP client"
Transport: TypeAlias = "Callable[[Event], Awaitable[None]]"
"""Serves clients on the event loop until the event is set."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as the transport knows it.

    Attributes:
        who: for the audit and the log.
        role: one of ROLES; anything else has no rights.
        client: which of several clients without a token; empty for others.
        watched: calls a listener when the connection of this request is lost within the block, or
            was before; None where that cancels the call, as on stdio.
        KEY: where a transport of a feature leaves the Holder in the scope of a request.
    """

    KEY: ClassVar = "roboneuron.holder"

    who: str
    role: str
    client: str = ""
    watched: Callable[[Callable[[], object]], AbstractContextManager[None]] | None = None

    @classmethod
    def local(cls, client: str = "") -> Holder:
        """A client of a server on loopback that asks for no token: anybody on this machine, who
        could start one as well. `client` tells it apart from others: "session 1a2b", "pid 123".
        """
        return cls(who=f"{_LOCAL_CLIENT} {client}".rstrip(), role=ADMIN, client=client)

    @staticmethod
    def is_local(who: str) -> bool:
        """Whether that client was let in without a token; no token can have such a name."""
        return who == LOCAL_AGENT.who or who.startswith(_LOCAL_CLIENT)


LOCAL_AGENT = Holder(who="agent on stdio", role=ADMIN)
"""The client of a stdio server: whoever started the server, so it has every role."""
NOBODY = Holder(who="unknown", role="")


def holder_of(request: Any) -> Holder:
    """Who sent a request; None is stdio. A request without a Holder has no rights."""
    if request is None:
        return LOCAL_AGENT
    holder = request.scope.get(Holder.KEY)
    return holder if isinstance(holder, Holder) else NOBODY


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
