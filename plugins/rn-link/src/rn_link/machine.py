"""The link of this machine, as stored by the command `roboneuron link` in the state directory.

Standard library only: every process imports this.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from ipaddress import IPv4Address
from pathlib import Path
from typing import Literal, NamedTuple

from roboneuron import ConfigurationError, ForeignDataError, foreign

Role = Literal["hub", "member"]
"""The hub admits machines and connects to its members, which listen."""
PORT = 7411
"""TCP port that a member listens on."""
LOOPBACK = "127.0.0.1"
RELAY = "127.90.0.1"
"""Address at which the relay receives announcements of this machine's participants."""
DISCOVERY_PORT = 7399
"""UDP port at that address; below those of ROS, which start at 7400."""
FILE, IDENTITY, PROFILE = "link.json", "own.pem", "fastdds.xml"
"""Files of the link's folder: `Machine`, this machine's certificate and key, the profile of ROS."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,30}")
_MOST_CERTIFICATE = 16_384


class Peer(NamedTuple):
    """Another machine of the link.

    Attributes:
        address: IPv4 address.
        certificate: the only one that it is known by; PEM.
    """

    address: str
    certificate: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Machine:
    """This machine's part of the link."""

    name: str
    role: Role
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
    """Raise ConfigurationError unless it is an IPv4 address."""
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


def read_machine(folder: Path) -> Machine | None:
    """Return this machine's part of the link; None if it has none.

    Raises:
        ConfigurationError: the file cannot be read, or is damaged.
    """
    path = folder / FILE
    try:
        facts = foreign.read_json(path)
        role = foreign.choice(foreign.field(facts, "role"), "role", ("hub", "member"))
        peers = foreign.table(foreign.field(facts, "peers"), "peers")
        if role == "member" and len(peers) != 1:
            raise ForeignDataError(f"a member has one hub, here {len(peers)}")
        return Machine(
            name=check_name(foreign.text(foreign.field(facts, "name"), "name")),
            role="hub" if role == "hub" else "member",
            peers={check_name(name): _peer(found) for name, found in peers.items()},
        )
    except FileNotFoundError:
        return None
    except (ForeignDataError, ConfigurationError) as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error}.",
            hint="Remove its folder and pair the machine again with `roboneuron link`.",
        ) from error


def _peer(facts: object) -> Peer:
    address, certificate = foreign.items(facts, "a machine", least=2, most=2)
    return Peer(
        check_address(foreign.text(address, "an address")),
        foreign.text(certificate, "a certificate", _MOST_CERTIFICATE),
    )
