"""Parameters and priorities shared by the server and a module process during a switch.

A module that is loaded while another one works runs with lower priority until it is loaded.
Scheduling is set per thread: children inherit it, and it is restored for all threads. An
unprivileged process can lower its priority but not raise it again. Without that right only the
batch policy is used, which never preempts a thread that wakes up for its next image, and can always
be left.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

ACCELERATION_PARAMETER = "acceleration"
"""ROS parameter of an inference module: name of the acceleration, or empty for none."""
ACT_FROM = "act_from_ns"
"""ROS parameter: inputs stamped before this ROS time [ns] are only processed in shadow. 0: none."""
ACT_UNTIL = "act_until_ns"
"""ROS parameter: inputs stamped at or after this ROS time [ns] are left to the successor.
0: none.
"""
PLAY_UNTIL = "play_until_ns"
"""ROS parameter: a chunk being played ends at this ROS time [ns]. 0: at its own end."""
PLAY_FROM = "play_from_ns"
"""ROS parameter: nothing is sent before this ROS time [ns]; the predecessor plays its rows until
then. 0: none.
"""
LISTENERS = "listeners."
"""Prefix of a module's metrics: number of subscriptions of its outputs, by topic."""
NEVER_NS = 2**62
"""Value of ACT_FROM for a module in shadow until the handover is set."""
log = logging.getLogger(__name__)
_NICENESS = 10
_CAP_SYS_NICE = 23
"""Source: linux/capability.h."""
_MOST = 19


def listeners(metrics: Mapping[str, str]) -> Mapping[str, int]:
    """Number of subscriptions of a module's outputs, by topic; what is no number is left out,
    because any node can report in the module's name.
    """
    return {
        key.removeprefix(LISTENERS): int(value)
        for key, value in metrics.items()
        if key.startswith(LISTENERS) and value.isdecimal() and len(value) < 10
    }


def lower(pid: int) -> None:
    """Lower the priority of a child process; steps that the system does not permit are skipped."""
    with suppress(OSError):
        if _may_restore():
            os.setpriority(
                os.PRIO_PROCESS, pid, min(_MOST, os.getpriority(os.PRIO_PROCESS, 0) + _NICENESS)
            )
        else:
            os.sched_setscheduler(pid, os.SCHED_BATCH, os.sched_param(0))


def restore() -> None:
    """Restore this process to the priority of its parent; does nothing if it has it already."""
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
    """True if this process may raise its priority again (CAP_SYS_NICE)."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> _CAP_SYS_NICE & 1)
    return False
