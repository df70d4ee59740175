"""Check whether a machine can answer the FCI every millisecond: measurements against limits.
`network_check` checks its network.

The limits are those of libfranka's documentation (system requirements, troubleshooting):
PREEMPT_RT, no power saving, and a round trip that leaves enough of 1 ms to the control loop.
Nothing in this module moves the arm.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
LATE_S = 0.0003
"""A wake-up with this delay leaves too little of a cycle."""
LATE_SHARE = 0.001
LONGEST_LATE_S = 0.010
"""Half of the 20 cycles after which the arm stops."""
LOCKED_BYTES = 100 * 1024 * 1024
PRIORITY = 20
_LOOPBACK = 127


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmFinding:
    """Result of one check.

    Attributes:
        name: name of the check, a stable word.
        verdict: "failed" means unfit for a real arm.
        found: the measured value, with the limit.
        hint: what to do; empty if all is well.
    """

    name: str
    verdict: Literal["ok", "warning", "failed"]
    found: str
    hint: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Timing:
    """Wake-up delays of a thread with a period of 1 ms.

    Attributes:
        late_s: float64 (n,), delay by cycle [s].
    """

    late_s: F64

    @property
    def missed(self) -> int:
        """Number of cycles with too large a delay."""
        return int((self.late_s > LATE_S).sum())


class SystemFiles:
    """System information in files below a root folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def text(self, path: str) -> str:
        """Stripped text of a file; empty if it does not exist."""
        try:
            return (self._root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""

    def texts(self, pattern: str) -> dict[str, str]:
        """Texts of all files that match a pattern, by path."""
        return {
            str(path.relative_to(self._root)): self.text(str(path))
            for path in sorted(self._root.glob(pattern))
        }

    def interface(self, host: str) -> str:
        """Network interface towards a host; empty if unknown."""
        try:
            wanted = struct.unpack("!I", socket.inet_aton(socket.gethostbyname(host)))[0]
        except OSError:
            return ""
        if wanted >> 24 == _LOOPBACK:
            return "lo"
        best = ("", -1)
        for line in self.text("proc/net/route").splitlines()[1:]:
            name, target, _, _, _, _, _, mask = line.split()[:8]
            network, bits = (socket.ntohl(int(value, 16)) for value in (target, mask))
            if wanted & bits == network and bits > best[1]:
                best = (name, bits)
        return best[0]


def check_machine(
    machine: SystemFiles, seconds: float, measure: Callable[[float], Timing] | None = None
) -> list[ArmFinding]:
    """Check kernel, priority, memory, power saving, and wake-up delays."""
    return [
        _kernel(machine),
        _priority(),
        _locked_memory(),
        _governor(machine),
        _idle_states(machine),
        _wake_ups((measure or wake_ups)(seconds)),
    ]


def _kernel(machine: SystemFiles) -> ArmFinding:
    release = machine.text("proc/sys/kernel/osrelease")
    if machine.text("sys/kernel/realtime") == "1":
        return ArmFinding(name="kernel", verdict="ok", found=f"PREEMPT_RT ({release})")
    return ArmFinding(
        name="kernel",
        verdict="failed",
        found=f"{release or 'unknown'} is not real-time: /sys/kernel/realtime is not 1",
        hint='Boot a PREEMPT_RT kernel (Debian: linux-image-rt-amd64); keep realtime = "required".',
    )


def _priority() -> ArmFinding:
    granted = _granted_priority()
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    told = "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
    if granted:
        return ArmFinding(
            name="priority",
            verdict="ok",
            found=f"SCHED_FIFO {PRIORITY} is granted (ulimit -r: {told})",
        )
    return ArmFinding(
        name="priority",
        verdict="failed",
        found=f"SCHED_FIFO {PRIORITY} is refused (ulimit -r: {told}, needed: 99)",
        hint="Add '@realtime - rtprio 99' to /etc/security/limits.conf, join that group, log in "
        "again.",
    )


def _granted_priority() -> bool:
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        return False
    os.sched_setscheduler(0, before, parameter)
    return True


def _locked_memory() -> ArmFinding:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    is_unlimited = limit == resource.RLIM_INFINITY
    told = "unlimited" if is_unlimited else f"{limit // 1024} KiB"
    if is_unlimited or limit >= LOCKED_BYTES or os.geteuid() == 0:
        return ArmFinding(name="locked-memory", verdict="ok", found=f"ulimit -l: {told}")
    return ArmFinding(
        name="locked-memory",
        verdict="warning",
        found=f"ulimit -l: {told}, wanted: {LOCKED_BYTES // 1024} KiB",
        hint="Add '@realtime - memlock 102400' to /etc/security/limits.conf, and log in again.",
    )


def _governor(machine: SystemFiles) -> ArmFinding:
    found = set(machine.texts("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor").values())
    if not found:
        return ArmFinding(
            name="governor", verdict="ok", found="the system does not change the clock of the CPU"
        )
    if found == {"performance"}:
        return ArmFinding(name="governor", verdict="ok", found="performance, on every CPU")
    return ArmFinding(
        name="governor",
        verdict="warning",
        found=f"{', '.join(sorted(found))}, wanted: performance",
        hint="cpupower frequency-set --governor performance",
    )


def _idle_states(machine: SystemFiles) -> ArmFinding:
    latencies = machine.texts("sys/devices/system/cpu/cpu0/cpuidle/state*/latency")
    enabled_us = [
        int(text)
        for path, text in latencies.items()
        if text.isdigit() and machine.text(path.replace("latency", "disable")) != "1"
    ]
    worst_us = max(enabled_us, default=0)
    if worst_us <= LATE_S * 1e6 / 2:
        return ArmFinding(
            name="idle-states", verdict="ok", found=f"the deepest takes {worst_us} us to leave"
        )
    return ArmFinding(
        name="idle-states",
        verdict="warning",
        found=f"the deepest takes {worst_us} us to leave, wanted: at most {LATE_S * 1e6 / 2:.0f} "
        "us",
        hint="cpupower idle-set --disable-by-latency 100",
    )


def wake_ups(seconds: float) -> Timing:
    """Measure wake-up delays with a period of 1 ms, with the priority of the control thread if
    granted.
    """
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    late = []
    try:
        due_s = time.monotonic() + 0.001
        for _ in range(max(1, int(seconds * 1000))):
            time.sleep(max(0.0, due_s - time.monotonic()))
            now_s = time.monotonic()
            late.append(now_s - due_s)
            due_s = max(due_s + 0.001, now_s)
    finally:
        if os.sched_getscheduler(0) != before:
            os.sched_setscheduler(0, before, parameter)
    return Timing(late_s=np.array(late))


def _wake_ups(timing: Timing) -> ArmFinding:
    count, longest_s = len(timing.late_s), float(timing.late_s.max())
    found = (
        f"{timing.missed} of {count} cycles of 1 ms began more than {LATE_S * 1e3:g} ms late, the "
        "latest "
        f"{longest_s * 1e3:.2f} ms; limits: {LATE_SHARE:.1%} of them, {LONGEST_LATE_S * 1e3:g} ms"
    )
    if timing.missed <= LATE_SHARE * count and longest_s <= LONGEST_LATE_S:
        return ArmFinding(name="cycles", verdict="ok", found=found)
    return ArmFinding(
        name="cycles",
        verdict="failed",
        found=found,
        hint="Needs a PREEMPT_RT kernel, the priority above, and no other heavy work; no virtual "
        "machine.",
    )
