"""Whether a machine and its network can answer the FCI every millisecond: measured, and judged by
limits.

The limits are those of libfranka's documentation (system requirements, troubleshooting):
PREEMPT_RT, no power saving, and a round trip that leaves the control loop its share of 1 ms.
Nothing here moves the arm.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import select
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
PORT = 1337
ROUND_TRIP_S = 0.0003
"""Median that leaves 0.7 ms for planning and the control box. Source: libfranka,
docs/troubleshooting.rst.
"""
WORST_ROUND_TRIP_S = 0.001
LATE_S = 0.0003
"""A wake-up that is this late leaves too little of a cycle."""
LATE_SHARE = 0.001
LONGEST_LATE_S = 0.010
"""Half of the 20 cycles after which the arm stops."""
LOCKED_BYTES = 100 * 1024 * 1024
PRIORITY = 20
_ECHO_REQUEST, _ECHO_ANSWER = 8, 0
_PROBES = 200
_LOOPBACK = 127
_TIMEOUT_S = 0.2
_CONNECT_S = 3.0


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmFinding:
    """One thing that was looked at.

    Attributes:
        name: what, a stable word.
        verdict: failed speaks against a real arm.
        found: what was found, with the limit.
        hint: what to do about it; empty when all is well.
    """

    name: str
    verdict: Literal["ok", "warning", "failed"]
    found: str
    hint: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Timing:
    """How late a thread was woken that asked for it each millisecond.

    Attributes:
        late_s: float64 (n,), by cycle.
    """

    late_s: F64

    @property
    def missed(self) -> int:
        """Cycles of which too little was left."""
        return int((self.late_s > LATE_S).sum())


class Machine:
    """What the system says of itself, below a root folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def text(self, path: str) -> str:
        """A file's text without white space around; empty where there is none."""
        try:
            return (self._root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""

    def texts(self, pattern: str) -> dict[str, str]:
        """The texts of all files of a pattern, by path."""
        return {
            str(path.relative_to(self._root)): self.text(str(path))
            for path in sorted(self._root.glob(pattern))
        }

    def interface(self, host: str) -> str:
        """The network card that leads to a host; empty where that cannot be told."""
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
    machine: Machine, seconds: float, measure: Callable[[float], Timing] | None = None
) -> list[ArmFinding]:
    """Kernel, priority, memory, power saving, and how late a thread is woken."""
    return [
        _kernel(machine),
        _priority(),
        _locked_memory(),
        _governor(machine),
        _idle_states(machine),
        _wake_ups((measure or wake_ups)(seconds)),
    ]


def check_network(machine: Machine, host: str, seconds: float) -> list[ArmFinding]:
    """Round trips to the control box, whether FCI is active there, and the network card that leads
    there.
    """
    return [_fci(host), judged_round_trips(round_trips(host, seconds)), card(machine, host)]


def _kernel(machine: Machine) -> ArmFinding:
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


def _governor(machine: Machine) -> ArmFinding:
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


def _idle_states(machine: Machine) -> ArmFinding:
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
    """Ask to be woken each millisecond, with the priority of the control thread where it is
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


def _fci(host: str) -> ArmFinding:
    try:
        socket.create_connection((host, PORT), _CONNECT_S).close()
    except ConnectionRefusedError:
        return ArmFinding(
            name="fci",
            verdict="failed",
            found=f"{host} is there and refuses port {PORT}",
            hint="Activate FCI in Desk; it stays active until the control box is restarted or FCI "
            "is ended there.",
        )
    except OSError as error:
        return ArmFinding(
            name="fci",
            verdict="failed",
            found=f"nobody answers at {host}: {error.strerror or error}",
            hint="Check the cable, the address, and that this machine's address is in the same "
            "network.",
        )
    return ArmFinding(name="fci", verdict="ok", found=f"{host} accepts connections on port {PORT}")


def round_trips(host: str, seconds: float) -> list[float] | str:
    """Times [s] of echo requests (ping) with the size of a state; why there are none where they are
    not allowed.
    """
    try:
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM, socket.IPPROTO_ICMP)
    except OSError:
        try:
            link = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)
        except OSError as error:
            return (
                f"echo requests are not allowed here ({error.strerror}); see sysctl "
                "net.ipv4.ping_group_range"
            )
    found: list[float] = []
    with link:
        try:
            link.connect((host, 0))
            for number in range(_PROBES):
                found.append(_round_trip(link, number))
                time.sleep(seconds / _PROBES)
        except OSError as error:
            return f"{host} cannot be reached: {error.strerror or error}"
    return found


def _round_trip(link: socket.socket, number: int) -> float:
    """Of one request [s]; inf without an answer in time."""
    payload = bytes(1200)
    header = struct.pack("!BBHHH", _ECHO_REQUEST, 0, 0, os.getpid() & 0xFFFF, number)
    header = struct.pack(
        "!BBHHH", _ECHO_REQUEST, 0, checksum(header + payload), os.getpid() & 0xFFFF, number
    )
    began_s = time.perf_counter()
    link.send(header + payload)
    while (left_s := began_s + _TIMEOUT_S - time.perf_counter()) > 0.0:
        if not select.select([link], [], [], left_s)[0]:
            break
        answer = link.recv(2048)
        # raw sockets show the IP header
        at = (answer[0] & 0x0F) * 4 if len(answer) > len(header) + len(payload) else 0
        if answer[at] == _ECHO_ANSWER and struct.unpack_from("!H", answer, at + 6)[0] == number:
            return time.perf_counter() - began_s
    return float("inf")


def checksum(data: bytes) -> int:
    """Internet checksum (RFC 1071) of an even number of bytes."""
    total = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    folded: int = ~total & 0xFFFF
    return folded


def judged_round_trips(times_s: list[float] | str) -> ArmFinding:
    """By `ROUND_TRIP_S` and `WORST_ROUND_TRIP_S`; none may be lost."""
    if isinstance(times_s, str):
        return ArmFinding(
            name="round-trip",
            verdict="warning",
            found=times_s,
            hint="Run this as root, or ping by hand.",
        )
    times = np.array(times_s)
    lost = int(np.isinf(times).sum())
    answered = times[np.isfinite(times)] if lost < len(times) else np.array([np.inf])
    median_s, worst_s = float(np.median(answered)), float(answered.max())
    jitter_s = float(np.percentile(answered, 99)) - median_s if lost < len(times) else np.inf
    found = (
        f"median {median_s * 1e3:.3f} ms, jitter (p99 - median) {jitter_s * 1e3:.3f} ms, worst "
        f"{worst_s * 1e3:.3f} ms, "
        f"{lost} of {len(times)} lost; limits: {ROUND_TRIP_S * 1e3:g}, -, "
        f"{WORST_ROUND_TRIP_S * 1e3:g} ms, 0"
    )
    if lost == 0 and median_s <= ROUND_TRIP_S and worst_s <= WORST_ROUND_TRIP_S:
        return ArmFinding(name="round-trip", verdict="ok", found=found)
    return ArmFinding(
        name="round-trip",
        verdict="failed",
        found=found,
        hint="A cable straight from a network card of its own to the control box: no switch, no "
        "Wi-Fi, no USB adapter.",
    )


def card(machine: Machine, host: str) -> ArmFinding:
    """The network card towards a host: wired, 1 Gbit/s, awake."""
    name = machine.interface(host)
    if not name or name == "lo":
        return ArmFinding(
            name="network-card", verdict="ok", found=f"{host} is reached without a network card"
        )
    folder = f"sys/class/net/{name}"
    speed, control = machine.text(f"{folder}/speed"), machine.text(f"{folder}/device/power/control")
    problems = []
    if (machine.texts(f"{folder}/wireless") or machine.texts(f"{folder}/phy80211/*")) or re.match(
        r"wl", name
    ):
        problems.append("it is wireless")
    if speed.isdigit() and int(speed) < 1000:
        problems.append(f"it runs at {speed} Mbit/s, wanted: 1000")
    if control == "auto":
        problems.append("its power saving is on")
    if problems:
        return ArmFinding(
            name="network-card",
            verdict="failed" if "it is wireless" in problems else "warning",
            found=f"{name}: {', '.join(problems)}",
            hint=f"Use a wired card; echo on > /{folder}/device/power/control; ethtool --set-eee "
            f"{name} eee off.",
        )
    return ArmFinding(
        name="network-card", verdict="ok", found=f"{name}, {speed or 'unknown'} Mbit/s"
    )
