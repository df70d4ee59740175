"""The link of this machine, as the command `roboneuron link` leaves it in the state directory.

Standard library alone: every process imports this.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from pathlib import Path
from typing import Literal, NamedTuple

from roboneuron import ConfigurationError

Role = Literal["hub", "member"]
"""The hub holds the certificate authority and connects to its members, which listen."""
FIRST_PORT = 7411
PORT_COUNT = 4
MOST_PORTS = 16
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,30}")
_FILE = "link.json"


class Ports(NamedTuple):
    """TCP ports that a machine's processes listen on, one each."""

    first: int = FIRST_PORT
    last: int = FIRST_PORT + PORT_COUNT - 1

    def __str__(self) -> str:
        return f"{self.first}-{self.last}"

    @property
    def numbers(self) -> range:
        """All of them."""
        return range(self.first, self.last + 1)


def parse_ports(first: int, count: int) -> Ports:
    """Check the bounds of a range of ports.

    Raises:
        ConfigurationError: a port is none, or there are too many.
    """
    if not (first >= 1024 and 1 <= count <= MOST_PORTS and first + count <= 65536):
        raise ConfigurationError(
            f"The link cannot use {count} ports from {first}.",
            hint=f"Name 1 to {MOST_PORTS} ports between 1024 and 65535.",
        )
    return Ports(first, first + count - 1)


class Peer(NamedTuple):
    """Another machine of the link.

    Attributes:
        address: IPv4 address.
        ports: that its processes listen on; those of a hub are not used.
    """

    address: str
    ports: Ports


@dataclass(frozen=True, kw_only=True, slots=True)
class Machine:
    """This machine's part of the link."""

    name: str
    role: Role
    ports: Ports = field(default_factory=Ports)
    peers: Mapping[str, Peer] = field(default_factory=dict)

    def to_json(self) -> str:
        """As it is kept."""
        facts = {
            "name": self.name,
            "role": self.role,
            "ports": self.ports,
            "peers": self.peers,
        }
        return json.dumps(facts, indent=2) + "\n"


def check_name(name: str) -> str:
    """Raises ConfigurationError for what is no name of a machine."""
    if not _NAME.fullmatch(name):
        raise ConfigurationError(
            f"{name[:60]!r} is not a name for a machine.",
            hint="Use up to 31 lower-case letters, digits and hyphens, such as gpu-1.",
        )
    return name


def check_address(address: str) -> str:
    """Raises ConfigurationError for what is no IPv4 address: the transport takes no names."""
    try:
        return str(IPv4Address(address))
    except ValueError as error:
        raise ConfigurationError(
            f"{address[:60]!r} is not an IPv4 address.", hint="Write it as 192.168.1.20."
        ) from error


def link_folder() -> Path:
    """Where keys, certificates and profile of this user's link are."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "roboneuron" / "link"


def read_machine(folder: Path) -> Machine | None:
    """Return this machine's part of the link; None when it has none.

    Raises:
        ConfigurationError: the file cannot be read, or was damaged.
    """
    path = folder / _FILE
    try:
        return _parse(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ConfigurationError) as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error}.",
            hint="Remove its folder and pair the machine again with `roboneuron link`.",
        ) from error


def _parse(facts: dict[str, object]) -> Machine:
    peers = facts["peers"]
    if facts["role"] not in ("hub", "member") or not isinstance(peers, dict):
        raise ValueError("it is no link")
    return Machine(
        name=check_name(str(facts["name"])),
        role="hub" if facts["role"] == "hub" else "member",
        ports=_ports(facts["ports"]),
        peers={
            check_name(name): Peer(check_address(address), _ports(ports))
            for name, (address, ports) in peers.items()
        },
    )


def _ports(found: object) -> Ports:
    if not isinstance(found, list) or [type(one) for one in found] != [int, int]:
        raise ValueError("a range of ports is two numbers")
    first, last = found
    return parse_ports(first, last - first + 1)
