"""Links of test machines, without interactive pairing."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rn_link.keys import add_peer, make_machine, new_identity, remove_all, remove_peer
from rn_link.machine import Machine, Peer
from roboneuron import ConfigurationError


class Paired(Protocol):
    """A machine of `link_machines`, or a folder alone."""

    name: str
    address: str

    @property
    def link(self) -> Path:
        """Folder of its link."""


@dataclass
class Place:
    """A machine without a namespace."""

    name: str
    link: Path
    address: str = "127.0.0.1"


def make_hub(folder: Path, name: str = "robot") -> None:
    """Make this the folder of a hub."""
    make_machine(folder, Machine(name=name, role="hub"), new_identity())


def admit(hub: Path, member: Path, name: str, at: Peer, *, hub_name: str = "robot") -> None:
    """Pair a member at that address with a hub; an earlier machine of that name or folder goes."""
    with suppress(ConfigurationError):
        remove_all(member)
    with suppress(ConfigurationError):
        remove_peer(hub, name)
    make_machine(member, Machine(name=name, role="member", port=at.port), new_identity())
    add_peer(hub, name, at, (member / "own.pem").read_bytes())
    add_peer(member, hub_name, Peer("127.0.0.1"), (hub / "own.pem").read_bytes())


def pair(hub: Paired, member: Paired) -> None:
    """Make `hub` a hub, unless it is one, and pair `member` with it."""
    if not (hub.link / "link.json").exists():
        make_hub(hub.link, hub.name)
    admit(hub.link, member.link, member.name, Peer(member.address), hub_name=hub.name)
