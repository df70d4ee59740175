"""Connections of the machines, published by the relay in a file.

Standard library only, like the relay.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import ssl
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from rn_link.machine import Machine, write_state
from roboneuron import ForeignDataError, foreign

log = logging.getLogger("rn_link")
STATE, LOCK = "relay.json", "relay.lock"
"""Files of the link's folder; a running relay holds the lock."""
_UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)


@dataclass(frozen=True, kw_only=True, slots=True)
class PeerConnection:
    """The connection to one machine.

    Attributes:
        since: time of connection, ISO 8601 in UTC; empty while not connected.
        error: why there is none, or why the last one ended.
        hint: remedy.
    """

    since: str = ""
    error: str = ""
    hint: str = ""

    @property
    def is_open(self) -> bool:
        """True if the machine is connected."""
        return bool(self.since)


def connected_now() -> PeerConnection:
    """A connection that begins now."""
    return PeerConnection(since=datetime.now(UTC).isoformat(timespec="seconds"))


class StateFile:
    """The connections of this machine, logged and stored in a file as they change."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / STATE
        self._peers: dict[str, PeerConnection] = {}

    def set(self, name: str, connection: PeerConnection) -> None:
        """Set the connection of a machine."""
        if self._peers.get(name) != connection:
            if connection.is_open:
                log.warning("Linked to %s.", name)
            else:
                log.warning("No link to %s: %s.", name, connection.error)
            self._peers[name] = connection
            self._write()

    def forget(self, name: str) -> None:
        """Delete a removed machine."""
        if self._peers.pop(name, None) is not None:
            self._write()

    def _write(self) -> None:
        write_state(
            self._path, json.dumps({name: asdict(one) for name, one in self._peers.items()})
        )


def read_connections(folder: Path) -> dict[str, PeerConnection] | None:
    """The connections by machine, as stored by this machine's relay; None if no relay runs."""
    try:
        lock = os.open(folder / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return None
    except BlockingIOError:
        pass  # it runs
    finally:
        os.close(lock)
    try:
        found = foreign.table(foreign.read_json(folder / STATE), STATE)
        return {
            name: foreign.to_dataclass(PeerConnection, facts, "a connection")
            for name, facts in found.items()
        }
    except FileNotFoundError:  # it is starting
        return {}
    except ForeignDataError as error:
        log.warning("The state of the connections is not known: %s.", error)
        return {}


def hint_for(machine: Machine, name: str, error: BaseException) -> str:
    """Remedy for a connection to a machine that failed or ended."""
    peer = machine.peers[name]
    if isinstance(error, ssl.SSLError):
        return f"Pair it again: `roboneuron link remove {name}` and `link add {name}` on the hub."
    if isinstance(error, ConnectionRefusedError):
        return f"Start RoboNeuron on {name}, or `roboneuron link run`."
    if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
        return "End the process that uses that port."
    if isinstance(error, TimeoutError) or (
        isinstance(error, OSError) and error.errno in _UNREACHABLE
    ):
        return f"Is {name} on, {peer.address} its address, and its TCP port {peer.port} open?"
    return f"Check {name} and the network; the connection is retried."
