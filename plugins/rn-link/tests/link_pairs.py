"""Links of test machines, without the pairing of persons."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from link_machines import Machine as Namespace

from rn_link.certificates import new_key, read_certificate
from rn_link.machine import Machine, Peer, Ports
from rn_link_pairing.keeping import add_member, become_hub, become_member

PORTS = Ports(7411, 7418)


def pair(hub: Namespace, member: Namespace, *, age_days: int = 0, days: int = 365) -> None:
    """Make `hub` a hub, unless it is one, and pair `member` with it, `age_days` ago."""
    now = datetime.now(UTC)
    if not (hub.link / "link.json").exists():
        become_hub(hub.link, hub.name, now, 365)
    key = new_key()
    certificates = add_member(
        hub.link,
        member.name,
        Peer(member.address, PORTS),
        key.public_key(),
        now - timedelta(days=age_days),
        days,
    )
    become_member(
        member.link,
        Machine(
            name=member.name,
            role="member",
            ports=PORTS,
            peers={hub.name: Peer(hub.address, PORTS)},
        ),
        key,
        certificates,
        read_certificate(hub.link / "ca.pem"),
    )
