"""Connections of a policy server: those that have not introduced themselves, and robots."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import Protocol

from roboneuron import ConfigurationError


class Connection(Protocol):
    """What is kept in the table.

    Attributes:
        address: of its other end.
    """

    address: str

    def interrupt(self) -> None:
        """End it, from any thread."""


class AdmissionTable:
    """Who is connected; callable from any thread.

    Args:
        most_robots: more are refused.
    """

    def __init__(self, most_robots: int) -> None:
        self._most_robots = most_robots
        self._lock = threading.Lock()
        self._unknown: dict[Connection, float] = {}
        self._robots: set[Connection] = set()
        self._refused = 0
        self._newest_refusal = ""

    @property
    def robots(self) -> int:
        """How many robots are connected."""
        return len(self._robots)

    @property
    def refusals(self) -> tuple[int, str]:
        """Connections that ended before they were a robot's, and why the newest did."""
        with self._lock:
            return self._refused, self._newest_refusal

    def add(self, connection: Connection) -> None:
        """One that has not introduced itself yet."""
        with self._lock:
            self._unknown[connection] = time.monotonic()

    def admit(self, connection: Connection) -> None:
        """It is a robot's from now on.

        Raises:
            ConfigurationError: there are too many robots.
            ConnectionError: it has taken too long.
        """
        with self._lock:
            if len(self._robots) >= self._most_robots:
                raise ConfigurationError(
                    f"{len(self._robots)} robots are connected to this server; no more are taken.",
                    hint="Raise `robots` in its [listen].",
                )
            if self._unknown.pop(connection, None) is None:
                raise ConnectionError("it has taken too long")
            self._robots.add(connection)

    def leave(self, connection: Connection, why: str) -> bool:
        """It is gone; whether it was a robot's."""
        with self._lock:
            self._unknown.pop(connection, None)
            is_robot = connection in self._robots
            self._robots.discard(connection)
        if not is_robot:
            self.note_refusal(connection.address, why)
        return is_robot

    def note_refusal(self, address: str, why: str) -> None:
        """Count a connection that did not become a robot's."""
        with self._lock:
            self._refused += 1
            self._newest_refusal = f"{address}: {why}"

    def interrupt_late(self, longest_s: float) -> None:
        """Hang up on those that have not introduced themselves for so long."""
        now_s = time.monotonic()
        with self._lock:
            late = [one for one, since_s in self._unknown.items() if now_s - since_s > longest_s]
        for connection in late:
            connection.interrupt()

    def interrupt_all(self) -> None:
        """Hang up on everybody."""
        with self._lock:
            connections = [*self._unknown, *self._robots]
        for connection in connections:
            connection.interrupt()

    def make_room(self, *, least: int) -> None:
        """Hang up on the oldest unknown connection of the address with most of them, when there are
        `least` of them.
        """
        with self._lock:
            if len(self._unknown) < least:
                return
            most = Counter(connection.address for connection in self._unknown).most_common(1)
            address = most[0][0]
            connection = next(one for one in self._unknown if one.address == address)
            del self._unknown[connection]
        connection.interrupt()
