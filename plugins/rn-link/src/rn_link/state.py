"""Connections of the machines, published by the relay in a file.

Standard library only, like the relay.
"""

from __future__ import annotations

import fcntl
from dataclasses import dataclass
from pathlib import Path

from roboneuron import foreign

STATE, LOCK = "relay.json", "relay.lock"
"""Files of the link's folder; a running relay holds the lock."""


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


def read_connections(folder: Path) -> dict[str, PeerConnection] | None:
    """The connections by machine, as stored by this machine's relay; None if no relay runs.

    Raises:
        ForeignDataError: the file is damaged.
    """
    try:
        with (folder / LOCK).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return None
    except FileNotFoundError:
        return None
    except BlockingIOError:
        pass  # it runs
    try:
        found = foreign.table(foreign.read_json(folder / STATE), STATE)
    except FileNotFoundError:  # it is starting
        return {}
    return {
        name: foreign.to_dataclass(PeerConnection, facts, "a connection")
        for name, facts in found.items()
    }
