"""Links of test machines, without interactive pairing."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from link_machines import Machine as Namespace

from rn_link.certificates import new_key, read_certificate
from rn_link.machine import PORT, Machine, Peer
from rn_link_pairing.keeping import add_member, become_hub, become_member


def pair(hub: Namespace, member: Namespace) -> None:
    """Make `hub` a hub, unless it is one, and pair `member` with it."""
    if not (hub.link / "link.json").exists():
        become_hub(hub.link, hub.name, datetime.now(UTC), 365)
    admit(hub, member.name, Peer(member.address), member.link)


def admit(
    hub: Namespace, name: str, peer: Peer, folder: Path, *, age_days: int = 0, days: int = 365
) -> None:
    """Admit a member, `age_days` ago, and store its files in `folder`."""
    key = new_key()
    then = datetime.now(UTC) - timedelta(days=age_days)
    certificate = add_member(hub.link, name, peer, key.public_key(), then, days)
    machine = Machine(
        name=name, role="member", port=peer.port, peers={hub.name: Peer(hub.address, PORT)}
    )
    become_member(folder, machine, key, certificate, read_certificate(hub.link / "ca.pem"))
