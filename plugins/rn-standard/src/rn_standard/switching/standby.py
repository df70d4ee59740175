"""What the server and a module process agree on when modules are switched: parameters, and
priorities.

A module that is loaded beside a working one gives way to it until it is loaded itself. Scheduling
is a matter of threads: what a process starts inherits it, and restoring goes through all threads.
An unprivileged process can make itself less urgent but not undo that, so without the right to do so
only the batch policy is used: it never interrupts a thread that wakes up for its next image, and
can always be left.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

ACCELERATION_PARAMETER = "acceleration"
"""ROS parameter of an inference module: name of the acceleration, or empty for none."""
ACT_FROM = "act_from_ns"
"""ROS parameter: what is stamped before this ROS time [ns] is only worked on in shadow. 0: none."""
ACT_UNTIL = "act_until_ns"
"""ROS parameter: what is stamped at or after this ROS time [ns] is left to the successor. 0: none.
"""
PLAY_UNTIL = "play_until_ns"
"""ROS parameter: a chunk that is being played out ends at this ROS time [ns]. 0: at its own end."""
PLAY_FROM = "play_from_ns"
"""ROS parameter: nothing is sent before this ROS time [ns]; the predecessor plays what it has until
then. 0: none.
"""
LISTENERS = "listeners."
"""Metrics of a module: subscriptions that its outputs have found, by topic."""
NEVER_NS = 2**62
"""As ACT_FROM: in shadow until told otherwise."""
log = logging.getLogger(__name__)
_NICENESS = 10
_CAP_SYS_NICE = 23
"""Source: linux/capability.h."""
_MOST = 19


def lower(pid: int) -> None:
    """Let a child process give way; what the system does not allow is left out."""
    with suppress(OSError):
        if _may_restore():
            os.setpriority(
                os.PRIO_PROCESS, pid, min(_MOST, os.getpriority(os.PRIO_PROCESS, 0) + _NICENESS)
            )
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
