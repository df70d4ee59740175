"""Checks of the network between this machine and the control box: round trips, the card, and FCI.
Limits as in `check`.
"""

from __future__ import annotations

import os
import re
import select
import socket
import struct
import time

import numpy as np

from rn_robot_fr3.fci.check import ArmFinding, SystemFiles

PORT = 1337
ROUND_TRIP_S = 0.0003
"""Median limit, which leaves 0.7 ms for planning and the control box. Source: libfranka,
docs/troubleshooting.rst.
"""
WORST_ROUND_TRIP_S = 0.001
_ECHO_REQUEST, _ECHO_ANSWER = 8, 0
_PROBES = 200
_TIMEOUT_S = 0.2
_CONNECT_S = 3.0


def check_network(machine: SystemFiles, host: str, seconds: float) -> list[ArmFinding]:
    """Check round trips to the control box, whether FCI is active, and the network card."""
    return [judged_fci(host), judged_round_trips(round_trips(host, seconds)), card(machine, host)]


def judged_fci(host: str) -> ArmFinding:
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
    """Times [s] of echo requests (ping) with the size of a state; a reason instead if they are not
    allowed.
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
    """Round-trip time of one request [s]; inf without an answer in time."""
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
        # raw sockets include the IP header
        at = (answer[0] & 0x0F) * 4 if len(answer) > len(header) + len(payload) else 0
        if is_answer(answer[at:], number):
            return time.perf_counter() - began_s
    return float("inf")


def is_answer(message: bytes, number: int) -> bool:
    """Whether an ICMP message answers the request of that number."""
    if len(message) < 8 or message[0] != _ECHO_ANSWER:
        return False
    (answered,) = struct.unpack_from("!H", message, 6)
    return bool(answered == number)


def checksum(data: bytes) -> int:
    """Internet checksum (RFC 1071) of an even number of bytes."""
    total = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    folded: int = ~total & 0xFFFF
    return folded


def judged_round_trips(times_s: list[float] | str) -> ArmFinding:
    """Check against `ROUND_TRIP_S` and `WORST_ROUND_TRIP_S`; no request may be lost."""
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


def card(machine: SystemFiles, host: str) -> ArmFinding:
    """Check the network card towards a host: wired, 1 Gbit/s, no power saving."""
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
