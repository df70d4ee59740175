"""Scheduling priority of the recorder below the control loop."""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys

_NICENESS = 10
"""Niceness that still leaves a tenth of each core on a busy machine, about what two cameras need.
SCHED_IDLE would leave nothing, and an unprivileged process cannot leave that policy again.
"""
_SLICE_NS = 100_000_000
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")
"""size, policy, flags, nice, priority, runtime, deadline, period."""
_SYS_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "riscv64": 274}


def give_way() -> None:
    """Lower the priority of this process's threads below those of other processes; later threads
    inherit it.

    An image wakes the model's process and the recorder at the same time. With SCHED_BATCH a
    recorder's thread that wakes up does not preempt a running one. With a slice longer than all
    others, it is preempted by any thread that wakes up (Linux 6.12; since 6.6 it would run until
    its slice or the timer's tick ends, which takes up to 4 ms).

    No privilege is needed. If a container or an older kernel refuses one of them, the others still
    apply.

    Source: sched(7), sched_setattr(2); PREEMPT_SHORT in kernel/sched/features.h of Linux 6.12.
    """
    os.nice(_NICENESS)
    number = _SYS_SCHED_SETATTR.get(platform.machine())
    if sys.platform != "linux" or number is None:
        return
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_BATCH, 0, niceness, 0, _SLICE_NS, 0, 0)
    ctypes.CDLL(None).syscall(number, 0, attributes, 0)
