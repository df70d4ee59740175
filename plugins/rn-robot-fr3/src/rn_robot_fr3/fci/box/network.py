"""A bad cable in one direction: datagrams are lost, doubled, late or out of order."""

from __future__ import annotations

import heapq
import itertools
import random
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Faults:
    """How bad.

    Attributes:
        loss, duplicate, reorder, delay: share of the datagrams that this happens to.
        delay_s: how late a delayed one is.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.002


DUPLICATE_S = 0.0004
REORDER_S = 0.0013
"""Later than the next one, which leaves 1 ms after it."""


class Cable:
    """What is under way; no clock of its own."""

    def __init__(self, seed: int) -> None:
        self.faults = Faults()
        self._random = random.Random(seed)
        self._under_way: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()
        self.silence = 0

    def put(self, datagram: bytes, now_s: float) -> None:
        """Send it off."""
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
        """What has arrived by now."""
        found = []
        while self._under_way and self._under_way[0][0] <= now_s:
            found.append(heapq.heappop(self._under_way)[2])
        return found

    def next_s(self) -> float | None:
        """When the next one arrives."""
        return self._under_way[0][0] if self._under_way else None

    def _push(self, due_s: float, datagram: bytes) -> None:
        heapq.heappush(self._under_way, (due_s, next(self._order), datagram))
