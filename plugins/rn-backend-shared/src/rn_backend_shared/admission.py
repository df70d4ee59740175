"""Connections of a policy server: unidentified ones, and those of robots."""

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
    """A connection in the table.

    Attributes:
        address: address of the peer.
        client: its owner; all connections of one client share one share.
    """

    address: str
    client: str

    def interrupt(self) -> None:
        """End the connection, from any thread."""


class AdmissionTable:
    """Table of the connections; callable from any thread.

    Args:
        most_robots: largest number of robots; further ones are refused.
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
        """Number of connected robots."""
        return len(self._robots)

    @property
    def refusals(self) -> tuple[int, str]:
        """Number of connections that ended before they were admitted as robots, and the reason of
        the newest.
        """
        with self._lock:
            return self._refused, self._newest_refusal

    def add(self, connection: ClientConnection) -> None:
        """Add a connection that has not identified itself yet."""
        with self._lock:
            self._unknown[connection] = time.monotonic()

    def admit(self, connection: ClientConnection) -> None:
        """Admit a connection as a robot's. If there are too many, the newest robot of the client
        with the most is disconnected, provided that this client keeps more than the new one's would
        have.

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
        """The robot to be disconnected for a new one of a client; None while the limit is not
        reached.
        """
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
        """Remove an ended connection; returns True if it was a robot's."""
        with self._lock:
            self._unknown.pop(connection, None)
            is_robot = connection in self._robots
            self._robots.pop(connection, None)
        if not is_robot:
            self.note_refusal(connection.address, why)
        return is_robot

    def note_refusal(self, address: str, why: str) -> None:
        """Count a connection that was not admitted as a robot."""
        with self._lock:
            self._refused += 1
            self._newest_refusal = f"{address}: {why}"

    def interrupt_late(self, longest_s: float) -> None:
        """End connections that have not identified themselves within this time."""
        now_s = time.monotonic()
        with self._lock:
            late = [one for one, since_s in self._unknown.items() if now_s - since_s > longest_s]
        for connection in late:
            connection.interrupt()

    def interrupt_all(self) -> None:
        """End all connections."""
        with self._lock:
            connections = [*self._unknown, *self._robots]
        for connection in connections:
            connection.interrupt()

    def make_room(self, *, least: int) -> None:
        """If there are at least `least` unidentified connections, end the oldest one of the address
        with the most.
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
    """The client that would still have more connections than `client` after giving one of them to
    it; None if there is none.

    Args:
        client: the one that wants another connection.
        clients: owners of the connections.
    """
    counts = Counter(clients)
    greedy, most = counts.most_common(1)[0]
    return greedy if most - 1 > counts[client] else None
