"""Present load of the machine, to distinguish a faulty module from one without CPU time."""

from __future__ import annotations

import os
from pathlib import Path

OVERLOADED = 2.0
"""Runnable tasks per core from which a module may be late without a fault: it gets half a core."""
_LOADAVG = Path("/proc/loadavg")


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def runnable_per_core(source: Path = _LOADAVG) -> float:
    """Number of tasks that run or wait for a core at this moment, per core; 0 if unknown.

    Source: proc(5), the fourth field of /proc/loadavg. The averages before it are over a minute and
    more, which is too slow.
    """
    try:
        running = int(source.read_text(encoding="ascii").split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return 0.0
    return (running - 1) / cores()  # one of them is this thread
