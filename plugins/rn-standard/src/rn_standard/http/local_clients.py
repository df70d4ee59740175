"""Clients of a server on loopback that asks for no token, told apart by their session or their
process.
"""

from __future__ import annotations

import re
from pathlib import Path

from roboneuron.feature import LOCAL_PROCESS, Holder, is_local

_PROCESS = re.compile(r" pid ([0-9]+)\b")


def local_client(client: str) -> Holder:
    """The client that `client` tells apart from others: "session 1a2b" or "pid 123"; empty when
    nothing does.
    """
    return Holder(
        who=f"{LOCAL_PROCESS.who} {client}".rstrip(), role=LOCAL_PROCESS.role, client=client
    )


def account_of(holder: Holder) -> str:
    """Whose share of connections and sessions a client uses: the token's, or that of all
    clients without one.
    """
    return LOCAL_PROCESS.who if holder.client else holder.who


def has_left(who: str) -> bool:
    """Whether that client was a process of this machine that is gone."""
    found = _PROCESS.search(who) if is_local(who) else None
    return found is not None and not Path(f"/proc/{found.group(1)}").exists()
