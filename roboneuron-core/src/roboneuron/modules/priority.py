"""A module that is loaded beside a working one gives way to it until it is loaded itself.

Scheduling is a matter of threads: what a process starts inherits it, and restoring goes through all threads. An
unprivileged process can make itself less urgent but not undo that, so without the right to do so only the batch policy
is used: it never interrupts a thread that wakes up for its next image, and can always be left.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

log = logging.getLogger(__name__)
_NICENESS = 10
_CAP_SYS_NICE = 23
"""Source: linux/capability.h."""
_MOST = 19


def lower(pid: int) -> None:
    """Let a child process give way; what the system does not allow is left out."""
    with suppress(OSError):
        if _may_restore():
            os.setpriority(os.PRIO_PROCESS, pid, min(_MOST, os.getpriority(os.PRIO_PROCESS, 0) + _NICENESS))
        else:
            os.sched_setscheduler(pid, os.SCHED_BATCH, os.sched_param(0))


def restore() -> None:
    """Make this process as urgent as its parent; does nothing where it is already."""
    try:
        niceness = os.getpriority(os.PRIO_PROCESS, os.getppid())
        for task in os.listdir("/proc/self/task"):
            thread = int(task)
            with suppress(ProcessLookupError):
                if os.sched_getscheduler(thread) == os.SCHED_BATCH:
                    os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
                if os.getpriority(os.PRIO_PROCESS, thread) > niceness:
                    os.setpriority(os.PRIO_PROCESS, thread, niceness)
    except OSError as error:
        log.warning("The priority cannot be restored: %s", error)


def _may_restore() -> bool:
    """Whether a process like this one may become more urgent again (CAP_SYS_NICE)."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> _CAP_SYS_NICE & 1)
    return False
