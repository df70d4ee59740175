"""A simulated cable between two test machines, with delay, loss and limited bandwidth."""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import threading
import time
from typing import NamedTuple

MOST_QUEUE_S = 0.5
_MOST_FRAME = 65_536
_NEW_NET = 0x40000000
_SET_INTERFACE = 0x400454CA
_TAP_WITHOUT_HEADER = 0x1002


class Link(NamedTuple):
    """Properties of a cable between two machines.

    Attributes:
        round_trip_ms: round-trip time of a small frame [ms].
        jitter_ms: maximum random delay added each way [ms].
        loss_percent: frames lost, each way [%].
        rate_mbit: bandwidth, each way [Mbit/s].
        burst_ms: mean length of bursts in which all frames of a way are lost [ms]; 0 for losses
            that are independent of each other.
    """

    round_trip_ms: float
    jitter_ms: float
    loss_percent: float
    rate_mbit: float
    burst_ms: float = 0.0

    @classmethod
    def of(cls, text: str) -> Link:
        """Parse a command-line argument: ROUND-TRIP/JITTER/LOSS~BURST/RATE."""
        round_trip, jitter, loss, rate = text.split("/")
        loss, _, burst = loss.partition("~")
        return cls(float(round_trip), float(jitter), float(loss), float(rate), float(burst or 0))


class Losses:
    """Decides which frames of one direction are lost.

    With bursts it is a continuous-time Markov chain of two states, good and bad, whose durations
    are exponentially distributed. Source: Gilbert, Capacity of a burst-noise channel (1960);
    Elliott, Estimates of error rates for codes on burst-noise channels (1963).

    Args:
        link: gives the share of lost frames and the mean burst length.
        drawn: random generator.
    """

    def __init__(self, link: Link, drawn: random.Random) -> None:
        self._share, self._random = link.loss_percent / 100, drawn
        bad_s = link.burst_ms / 1e3
        good_s = bad_s * (1 / self._share - 1) if self._share else 0.0
        self._mean_s = {True: bad_s, False: good_s}
        self._is_bad = drawn.random() < self._share
        self._until_s: float | None = None

    def takes(self, now_s: float) -> bool:
        """Whether a frame at time `now_s` [s] is lost; the times of successive calls must not
        decrease.
        """
        if not self._share or not self._mean_s[True]:
            return self._random.random() < self._share
        if self._until_s is None:
            self._until_s = now_s + self._lasts_s()
        while now_s >= self._until_s:
            self._is_bad = not self._is_bad
            self._until_s += self._lasts_s()
        return self._is_bad

    def _lasts_s(self) -> float:
        return self._random.expovariate(1 / self._mean_s[self._is_bad])


def open_tap(pid: int, device: str) -> int:
    """Create an Ethernet device in a process's network namespace; returns its other end."""
    made: list[int] = []

    def enter() -> None:  # on a new thread, because a change of namespace affects only its thread
        with open(f"/proc/{pid}/ns/net", "rb") as namespace:
            libc = ctypes.CDLL(None, use_errno=True)
            if libc.setns(namespace.fileno(), _NEW_NET) != 0:
                raise OSError(ctypes.get_errno(), "setns")
        tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        request = struct.pack("16sH22x", device.encode(), _TAP_WITHOUT_HEADER)
        fcntl.ioctl(tap, _SET_INTERFACE, request)
        made.append(tap)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join(5.0)
    return made[0]


class SlowCable:
    """Relays frames between two devices, in order, from `start` to `close`."""

    def __init__(self, ends: tuple[int, int], link: Link) -> None:
        self._others = dict(zip(ends, reversed(ends), strict=True))
        self._link = link
        self._random = random.Random(1)
        self._losses = {end: Losses(link, self._random) for end in ends}
        self._free_s = dict.fromkeys(ends, 0.0)
        self._last_s = dict.fromkeys(ends, 0.0)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        """Start the relay thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the relay thread."""
        self._stopping.set()
        self._thread.join(5.0)

    def _due_s(self, end: int, size: int) -> float | None:
        """Time at which a frame from this end is delivered [s, monotonic]; None when it is lost."""
        link, now_s = self._link, time.monotonic()
        if self._losses[end].takes(now_s):
            return None
        begin_s = max(now_s, self._free_s[end])
        if begin_s - now_s > MOST_QUEUE_S:
            return None
        self._free_s[end] = begin_s + size * 8 / (link.rate_mbit * 1e6)
        late_ms = link.round_trip_ms / 2 + self._random.uniform(0, link.jitter_ms)
        due_s = max(self._free_s[end] + late_ms / 1e3, self._last_s[end])
        self._last_s[end] = due_s
        return due_s

    def _run(self) -> None:
        waiting: list[tuple[float, int, int, bytes]] = []
        number = 0
        ends = tuple(self._others)
        while not self._stopping.is_set():
            wait_s = 0.05 if not waiting else max(0.0, waiting[0][0] - time.monotonic())
            ready, _, _ = select.select(ends, [], [], min(wait_s, 0.05))
            for end in ready:
                frame = os.read(end, _MOST_FRAME)
                due_s = self._due_s(end, len(frame))
                if due_s is not None:
                    number += 1
                    heapq.heappush(waiting, (due_s, number, self._others[end], frame))
            while waiting and waiting[0][0] <= time.monotonic():
                *_, end, frame = heapq.heappop(waiting)
                try:
                    os.write(end, frame)
                except BlockingIOError:  # the device's queue is full: a packet is lost
                    continue
