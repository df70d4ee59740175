"""The link of this machine, as stored by the command `roboneuron link` in the state directory.

Standard library only: every process imports this.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from ipaddress import IPv4Address
from pathlib import Path
from typing import Literal, NamedTuple

from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    foreign,
)

log = logging.getLogger("rn_link")
Role = Literal["hub", "member"]
"""The hub admits machines and connects to its members, which listen."""
PORT = 7411
"""TCP port that a member listens on."""
LOOPBACK = "127.0.0.1"
RELAY = "127.90.0.1"
"""Address at which the relay receives announcements of this machine's participants."""
THERE = "127.90.1.1"
"""Address at which the relay receives messages for participants of other machines."""
DISCOVERY_PORT = 7399
"""UDP port at that address; below those of ROS, which start at 7400."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,30}")
FILE = "link.json"


def check_port(port: int) -> int:
    """Raise ConfigurationError unless it is a port of an unprivileged process."""
    if not 1024 <= port <= 65535:
        raise ConfigurationError(
            f"The link cannot use port {port}.", hint="Name one between 1024 and 65535."
        )
    return port


class Peer(NamedTuple):
    """Another machine of the link.

    Attributes:
        address: IPv4 address.
        port: TCP port that it listens on; that of a hub is not used.
    """

    address: str
    port: int = PORT


@dataclass(frozen=True, kw_only=True, slots=True)
class Machine:
    """This machine's part of the link."""

    name: str
    role: Role
    port: int = PORT
    peers: Mapping[str, Peer] = field(default_factory=dict)

    def to_json(self) -> str:
        """JSON of the link's file."""
        return json.dumps(asdict(self), indent=2) + "\n"


def check_name(name: str) -> str:
    """Raise ConfigurationError unless it is a valid name of a machine."""
    if not _NAME.fullmatch(name):
        raise ConfigurationError(
            f"{name[:60]!r} is not a name for a machine.",
            hint="Use up to 31 lower-case letters, digits and hyphens, such as gpu-1.",
        )
    return name


def check_address(address: str) -> str:
    """Raise ConfigurationError unless it is an IPv4 address: the transport does not resolve
    names.
    """
    try:
        return str(IPv4Address(address))
    except ValueError as error:
        raise ConfigurationError(
            f"{address[:60]!r} is not an IPv4 address.", hint="Write it as 192.168.1.20."
        ) from error


def link_folder() -> Path:
    """Folder of the keys, certificates and profile of this user's link."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "roboneuron" / "link"


def write_state(path: Path, text: str) -> None:
    """Replace a file of the relay, unless that fails, as while the link is being removed."""
    fresh = path.with_suffix(".new")
    try:
        fresh.write_text(text, encoding="utf-8")
        fresh.replace(path)
    except OSError as error:
        log.warning("%s cannot be saved: %s", path.name, error)


def read_machine(folder: Path) -> Machine | None:
    """Return this machine's part of the link; None if it has none.

    Raises:
        ConfigurationError: the file cannot be read, or is damaged.
    """
    path = folder / FILE
    try:
        return _parse(foreign.read_json(path))
    except FileNotFoundError:
        return None
    except (ForeignDataError, ConfigurationError) as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error}.",
            hint="Remove its folder and pair the machine again with `roboneuron link`.",
        ) from error


def _parse(facts: object) -> Machine:
    role = foreign.choice(foreign.field(facts, "role"), "role", ("hub", "member"))
    peers = foreign.table(foreign.field(facts, "peers"), "peers")
    return Machine(
        name=check_name(foreign.text(foreign.field(facts, "name"), "name")),
        role="hub" if role == "hub" else "member",
        port=check_port(foreign.integer(foreign.field(facts, "port"), "port")),
        peers={check_name(name): _peer(facts) for name, facts in peers.items()},
    )


def _peer(facts: object) -> Peer:
    address, port = foreign.items(facts, "a machine", least=2, most=2)
    place = check_address(foreign.text(address, "an address"))
    return Peer(place, check_port(foreign.integer(port, "a port")))
