"""Connections of a policy server: those that have not introduced themselves, and robots."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from roboneuron import ConfigurationError

log = logging.getLogger(__name__)


class ClientConnection(Protocol):
    """What is kept in the table.

    Attributes:
        address: of its other end.
        client: whose it is; all connections of one get one share.
    """

    address: str
    client: str

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
        self._unknown: dict[ClientConnection, float] = {}
        self._robots: dict[ClientConnection, None] = {}
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

    def add(self, connection: ClientConnection) -> None:
        """One that has not introduced itself yet."""
        with self._lock:
            self._unknown[connection] = time.monotonic()

    def admit(self, connection: ClientConnection) -> None:
        """It is a robot's from now on. When there are too many, the newest of the client with most
        of them gives way, if that keeps more than the new one's then.

        Raises:
            ConfigurationError: there are too many robots.
            ConnectionError: it has taken too long.
        """
        with self._lock:
            given_up = self._given_up(connection.client)
            if self._unknown.pop(connection, None) is None:
                raise ConnectionError("it has taken too long")
            self._robots[connection] = None
            if given_up is not None:
                del self._robots[given_up]
        if given_up is not None:
            log.warning("%s has most of the robots; its newest gives way.", given_up.address)
            given_up.interrupt()

    def _given_up(self, client: str) -> ClientConnection | None:
        """What gives way to a new robot of a client; None while there are not too many."""
        if len(self._robots) < self._most_robots:
            return None
        greedy = crowded(client, [robot.client for robot in self._robots])
        if greedy is None:
            raise ConfigurationError(
                f"{len(self._robots)} robots are connected to this server; no more are taken.",
                hint="Raise `robots` in its [listen].",
            )
        return next(robot for robot in reversed(self._robots) if robot.client == greedy)

    def leave(self, connection: ClientConnection, why: str) -> bool:
        """It is gone; whether it was a robot's."""
        with self._lock:
            self._unknown.pop(connection, None)
            is_robot = connection in self._robots
            self._robots.pop(connection, None)
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


def crowded(client: str, clients: Sequence[str]) -> str | None:
    """The client with so many connections that it has more than `client` when one of them is taken
    from it and given to that; None when nobody has.

    Args:
        client: who wants one more.
        clients: whose the connections are.
    """
    counts = Counter(clients)
    greedy, most = counts.most_common(1)[0]
    return greedy if most - 1 > counts[client] else None
