"""A bad cable in one direction: datagrams are lost, duplicated, delayed or reordered."""

from __future__ import annotations

import heapq
import itertools
import random
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Faults:
    """Fault rates.

    Attributes:
        loss, duplicate, reorder, delay: share of affected datagrams.
        delay_s: delay of a delayed datagram.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.002


DUPLICATE_S = 0.0004
REORDER_S = 0.0013
"""Later than the next datagram, which is sent 1 ms after it."""


class Cable:
    """Datagrams in transit; has no clock."""

    def __init__(self, seed: int) -> None:
        self.faults = Faults()
        self._random = random.Random(seed)
        self._under_way: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()
        self.silence = 0

    def put(self, datagram: bytes, now_s: float) -> None:
        """Send a datagram."""
        dice, faults = self._random.random, self.faults
        if self.silence > 0:
            self.silence -= 1
            return
        if dice() < faults.loss:
            return
        due_s = now_s
        if dice() < faults.reorder:
            due_s += REORDER_S
        if dice() < faults.delay:
            due_s += faults.delay_s
        self._push(due_s, datagram)
        if dice() < faults.duplicate:
            self._push(due_s + DUPLICATE_S, datagram)

    def arrived(self, now_s: float) -> list[bytes]:
        """Datagrams that have arrived by now."""
        found = []
        while self._under_way and self._under_way[0][0] <= now_s:
            found.append(heapq.heappop(self._under_way)[2])
        return found

    def next_s(self) -> float | None:
        """Arrival time of the next datagram."""
        return self._under_way[0][0] if self._under_way else None

    def _push(self, due_s: float, datagram: bytes) -> None:
        heapq.heappush(self._under_way, (due_s, next(self._order), datagram))
