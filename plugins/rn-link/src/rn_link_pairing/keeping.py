"""Changes of this machine's part of the link; the only module that writes its files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from rn_link.certificates import (
    Issuer,
    issue,
    key_to_pem,
    new_issuer,
    new_key,
    read_certificate,
    read_key,
    to_pem,
    write_private,
)
from rn_link.machine import Machine, Peer, alias, check_name, read_machine
from rn_link.profile import fast_dds_profile
from roboneuron import ConfigurationError


def read_hub(folder: Path) -> Machine:
    """Return this machine's part of the link.

    Raises:
        ConfigurationError: it is not the hub.
    """
    machine = read_machine(folder)
    if machine is None:
        raise ConfigurationError(
            "This machine has no certificate authority.",
            hint="Type `roboneuron link init` first, on the robot's machine.",
        )
    if machine.role != "hub":
        hub = next(iter(machine.peers), "the hub")
        raise ConfigurationError(
            f"This machine is a member of the link of {hub}.", hint=f"Type the command on {hub}."
        )
    return machine


def become_hub(folder: Path, name: str, now: datetime, days: int) -> Machine:
    """Create the certificate authority and this machine's certificate, or renew the certificate.

    Raises:
        ConfigurationError: this machine is a member of another link.
    """
    found = read_machine(folder)
    machine = Machine(name=check_name(name), role="hub") if found is None else read_hub(folder)
    _make_folder(folder)
    if found is None:
        made = new_issuer(machine.name, now)
        write_private(folder / "ca.key", key_to_pem(made.key))
        write_private(folder / "ca.pem", to_pem(made.certificate))
    issuer = Issuer(read_key(folder / "ca.key"), read_certificate(folder / "ca.pem"))
    key = new_key()
    certificate = issue(issuer, machine.name, "hub", key.public_key(), now, days)
    write_private(folder / "own.key", key_to_pem(key))
    write_private(folder / "own.pem", to_pem(certificate))
    _publish(folder, machine)
    return machine


def add_member(
    folder: Path, name: str, peer: Peer, key: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.Certificate:
    """Admit a machine, replacing an earlier one of that name, and return its certificate.

    The key of its issuer is discarded, so that no further certificate can be issued with it.

    Raises:
        ConfigurationError: this machine is not the hub, or the name cannot be used.
    """
    hub = read_hub(folder)
    _check_alias(name, hub)
    issuer = new_issuer(check_name(name), now)
    certificate = issue(issuer, name, "member", key, now, days)
    write_private(folder / "peers" / f"{name}.pem", to_pem(certificate))
    write_private(folder / "peers" / f"{name}.issuer.pem", to_pem(issuer.certificate))
    _publish(folder, replace(hub, peers={**hub.peers, name: peer}))
    return certificate


def _check_alias(name: str, hub: Machine) -> None:
    for other in hub.peers:
        if other != name and alias(other) == alias(name):
            raise ConfigurationError(
                f"The names {name!r} and {other!r} lead to the same address of the relay.",
                hint="Give the machine another name.",
            )


def become_member(
    folder: Path,
    machine: Machine,
    key: ec.EllipticCurvePrivateKey,
    certificate: x509.Certificate,
    trusted: x509.Certificate,
) -> None:
    """Store the certificates issued by a hub for this machine; `trusted` is the issuer of the
    hub.
    """
    _make_folder(folder)
    (hub,) = machine.peers
    write_private(folder / "own.key", key_to_pem(key))
    write_private(folder / "own.pem", to_pem(certificate))
    write_private(folder / "peers" / f"{hub}.issuer.pem", to_pem(trusted))
    _publish(folder, machine)


def remove_peer(folder: Path, name: str) -> Machine:
    """Revoke a machine; on a member, leave the link.

    Raises:
        ConfigurationError: no such machine is paired.
    """
    machine = read_machine(folder)
    if machine is None or name not in machine.peers:
        known = sorted(machine.peers) if machine is not None else []
        raise ConfigurationError(
            f"No machine {name[:60]!r} is paired with this one.",
            hint=f"Paired: {', '.join(known) or 'none'}.",
        )
    if machine.role == "member":
        remove_all(folder)
        return replace(machine, peers={})
    left = replace(machine, peers={k: v for k, v in machine.peers.items() if k != name})
    _publish(folder, left)
    for file in (f"{name}.pem", f"{name}.issuer.pem"):
        (folder / "peers" / file).unlink(missing_ok=True)
    return left


def remove_all(folder: Path) -> None:
    """Remove keys, certificates and authority of this machine.

    Raises:
        ConfigurationError: there are none.
    """
    if not folder.is_dir():
        raise ConfigurationError("This machine has no link.", hint="There is nothing to remove.")
    # first the file that makes processes use the link
    (folder / "link.json").unlink(missing_ok=True)
    shutil.rmtree(folder)


def _make_folder(folder: Path) -> None:
    (folder / "peers").mkdir(parents=True, exist_ok=True)
    for one in (folder, folder / "peers"):
        one.chmod(0o700)


def _publish(folder: Path, machine: Machine) -> None:
    """Write the files that processes read; last the one that makes them use the link."""
    write_private(folder / "fastdds.xml", fast_dds_profile().encode())
    write_private(folder / "link.json", machine.to_json().encode())
