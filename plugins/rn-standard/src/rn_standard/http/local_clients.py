"""Clients of a loopback server without tokens, distinguished by their session or process."""

from __future__ import annotations

import re
from pathlib import Path

from roboneuron.feature import Holder

_PROCESS = re.compile(r" pid ([0-9]+)\b")


def account_of(holder: Holder) -> str:
    """Account for a client's share of connections and sessions: its token, or that of all clients
    without one.
    """
    return Holder.local().who if holder.client else holder.who


def has_left(who: str) -> bool:
    """True if that client was a process of this machine that has ended."""
    found = _PROCESS.search(who) if Holder.is_local(who) else None
    return found is not None and not Path(f"/proc/{found.group(1)}").exists()
