"""Overload of this computer, as a reason for late messages."""

from __future__ import annotations

import os

_OVERLOADED = 1.5
"""Runnable processes for each core from which modules are late."""


def overload() -> str:
    """The load of this computer as a clause, if it is too high; otherwise empty."""
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load <= _OVERLOADED * cores:
        return ""
    return f"this computer is overloaded (load {load:.0f} on {cores} cores)"
