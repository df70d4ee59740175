"""Who calls, and what a role may call: the only place where roles and tools meet."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboneuron.errors import RefusedError
from roboneuron.gate.request import ADMIN, OPERATOR, VIEWER, has_role
from roboneuron.server.tool import CallContext, DerivedTool, Tool

_PROCESS = re.compile(r" pid ([0-9]+)\b")
HOLDER_KEY = "roboneuron.holder"
"""Where the HTTP border leaves the Holder in the ASGI scope of a request."""


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

    @property
    def account(self) -> str:
        """Whose share of connections and sessions it uses: the token's, or that of all clients without one."""
        return LOCAL_PROCESS.who if self.client else self.who


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
    return who == LOCAL_AGENT.who or who.startswith(LOCAL_PROCESS.who)


def local_client(client: str) -> Holder:
    """A client of a server that asks for no token, told apart from others by its session or its process."""
    return Holder(who=f"{LOCAL_PROCESS.who} {client}".rstrip(), role=LOCAL_PROCESS.role, client=client)


def has_left(who: str) -> bool:
    """Whether that client was a process of this machine that is gone."""
    found = _PROCESS.search(who) if is_local(who) else None
    return found is not None and not Path(f"/proc/{found.group(1)}").exists()


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
