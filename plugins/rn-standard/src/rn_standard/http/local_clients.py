"""Clients of a server on loopback that asks for no token, told apart by their session or their
process.
"""

from __future__ import annotations

import re
from pathlib import Path

from roboneuron.feature import access

_PROCESS = re.compile(r" pid ([0-9]+)\b")


def local_client(client: str) -> access.Holder:
    """The client that `client` tells apart from others: "session 1a2b" or "pid 123"; empty when
    nothing does.
    """
    return access.Holder(
        who=f"{access.LOCAL_PROCESS.who} {client}".rstrip(),
        role=access.LOCAL_PROCESS.role,
        client=client,
    )


def account_of(holder: access.Holder) -> str:
    """Whose share of connections and sessions a client uses: the token's, or that of all clients
    without one.
    """
    return access.LOCAL_PROCESS.who if holder.client else holder.who


def has_left(who: str) -> bool:
    """Whether that client was a process of this machine that is gone."""
    found = _PROCESS.search(who) if access.is_local(who) else None
    return found is not None and not Path(f"/proc/{found.group(1)}").exists()
