"""Links of test machines, without interactive pairing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Protocol

from rn_link.keys import (
    add_peer,
    make_machine,
    new_identity,
    own_certificate,
    remove_all,
    remove_peer,
    to_certificate,
)
from rn_link.machine import Machine, Peer
from roboneuron import ConfigurationError


class Paired(Protocol):
    """A machine of `link_machines`."""

    name: str
    address: str

    @property
    def link(self) -> Path:
        """Folder of its link."""


def make_hub(folder: Path, name: str = "robot") -> None:
    """Make this the folder of a hub."""
    make_machine(folder, Machine(name=name, role="hub"), new_identity())


def admit(
    hub: Path, member: Path, name: str, address: str = "127.0.0.1", *, hub_name: str = "robot"
) -> None:
    """Pair a member at that address with a hub; an earlier machine of that name or folder goes."""
    with suppress(ConfigurationError):
        remove_all(member)
    with suppress(ConfigurationError):
        remove_peer(hub, name)
    identity = new_identity()
    peers = {hub_name: Peer("127.0.0.1", own_certificate(hub))}
    make_machine(member, Machine(name=name, role="member", peers=peers), identity)
    add_peer(hub, name, Peer(address, to_certificate(identity)))


def pair(hub: Paired, member: Paired) -> None:
    """Make `hub` a hub, unless it is one, and pair `member` with it."""
    if not (hub.link / "link.json").exists():
        make_hub(hub.link, hub.name)
    admit(hub.link, member.link, member.name, member.address, hub_name=hub.name)
