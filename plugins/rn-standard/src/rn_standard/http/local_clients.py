"""Clients of a server on loopback that asks for no token, told apart by their session or their
process.
"""

from __future__ import annotations

import re
from pathlib import Path

from roboneuron.feature import Holder

_PROCESS = re.compile(r" pid ([0-9]+)\b")


def account_of(holder: Holder) -> str:
    """Whose share of connections and sessions a client uses: the token's, or that of all clients
    without one.
    """
    return Holder.local().who if holder.client else holder.who


def has_left(who: str) -> bool:
    """Whether that client was a process of this machine that is gone."""
    found = _PROCESS.search(who) if Holder.is_local(who) else None
    return found is not None and not Path(f"/proc/{found.group(1)}").exists()
