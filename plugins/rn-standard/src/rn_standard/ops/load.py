"""How busy the machine is just now: to tell a module that is at fault from one that gets no
processor time.
"""

from __future__ import annotations

import os
from pathlib import Path

OVERLOADED = 2.0
"""Runnable tasks for each core from which on a module may be late through no fault of its own: it
gets half a core.
"""
_LOADAVG = Path("/proc/loadavg")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def runnable_per_core(source: Path = _LOADAVG) -> float:
    """Tasks that run or wait for a core at this moment, for each core; 0 where the system does not
    tell.

    Source: proc(5), the fourth field of /proc/loadavg. The averages before it are of a minute and
    more, too late here.
    """
    try:
        running = int(source.read_text(encoding="ascii").split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return 0.0
    return (running - 1) / cores()  # one of them is this thread
