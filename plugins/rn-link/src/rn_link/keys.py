"""This machine's key, its certificate and those of its peers; the only module that writes them.

Each machine signs its own certificate and trusts exactly the certificates in `peers/`: there is no
authority, and removing a file revokes a machine. They do not expire, so that no robot stops on a
day that nobody thought of, or because its clock is wrong.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from rn_link.machine import FILE, Machine, Peer, check_name, read_machine
from rn_link.profile import fast_dds_profile
from roboneuron import ConfigurationError

_SINCE = datetime(2000, 1, 1, tzinfo=UTC)
_FOR_EVER = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)
"""No end of validity. Source: RFC 5280, 4.1.2.5."""


class Identity(NamedTuple):
    """A key and its certificate (PEM)."""

    key: bytes
    certificate: bytes


def new_identity() -> Identity:
    """Return a new key (P-256), without a password because modules start without a person, and its
    self-signed certificate.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "RoboNeuron link")])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_SINCE)
        .not_valid_after(_FOR_EVER)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Identity(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        ),
        certificate.public_bytes(serialization.Encoding.PEM),
    )


def to_certificate(text: str) -> bytes:
    """Return the first certificate of a PEM text, and nothing else of it; raises ValueError."""
    found = x509.load_pem_x509_certificate(text.encode())
    return found.public_bytes(serialization.Encoding.PEM)


def check_no_link(folder: Path) -> None:
    """Raise ConfigurationError if this machine has a link."""
    found = read_machine(folder)
    if found is not None:
        raise ConfigurationError(
            f"This machine is the {found.role} {found.name} of a link already.",
            hint="Type `roboneuron link remove --all` first, if the link is no longer needed.",
        )


def make_machine(folder: Path, machine: Machine, identity: Identity) -> None:
    """Store this machine's part of a link, still without peers.

    Raises:
        ConfigurationError: it has one, or the name cannot be used.
    """
    check_name(machine.name)
    check_no_link(folder)
    for one in (folder, folder / "peers"):
        one.mkdir(parents=True, exist_ok=True)
        one.chmod(0o700)
    write_private(folder / "own.key", identity.key)
    write_private(folder / "own.pem", identity.certificate)
    _publish(folder, machine)


def check_new_peer(folder: Path, name: str) -> Machine:
    """Return this machine's part of the link, if a machine of that name can be added.

    Raises:
        ConfigurationError: this machine has no link, has a hub already, or the name is taken.
    """
    machine = read_machine(folder)
    if machine is None:
        raise ConfigurationError(
            "This machine has no link.",
            hint="Type `roboneuron link init` first, on the robot's machine.",
        )
    if machine.role == "member" and machine.peers:
        (hub,) = machine.peers
        raise ConfigurationError(
            f"This machine is a member of the link of {hub}.", hint=f"Type the command on {hub}."
        )
    if check_name(name) == machine.name:
        raise ConfigurationError(
            f"{name!r} is this machine itself.", hint="Name the other machine, such as gpu-1."
        )
    if name in machine.peers:
        raise ConfigurationError(
            f"A machine {name!r} is paired already.",
            hint=f"Choose another name, or type `roboneuron link remove {name}` first.",
        )
    return machine


def add_peer(folder: Path, name: str, peer: Peer, certificate: bytes) -> None:
    """Trust a machine, whose certificate (PEM) this is; raises as `check_new_peer`."""
    machine = check_new_peer(folder, name)
    write_private(_certificate_of(folder, name), certificate)
    _publish(folder, replace(machine, peers={**machine.peers, name: peer}))


def remove_peer(folder: Path, name: str) -> None:
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
        return
    left = {other: peer for other, peer in machine.peers.items() if other != name}
    _publish(folder, replace(machine, peers=left))
    _certificate_of(folder, name).unlink(missing_ok=True)


def remove_all(folder: Path) -> None:
    """Remove all keys and certificates of this machine.

    Raises:
        ConfigurationError: there are none.
    """
    if not folder.is_dir():
        raise ConfigurationError("This machine has no link.", hint="There is nothing to remove.")
    # first the file that makes processes use the link
    (folder / FILE).unlink(missing_ok=True)
    shutil.rmtree(folder)


def write_private(path: Path, content: bytes) -> None:
    """Replace a file atomically by one that only this user may read."""
    fresh = path.with_name(f".{path.name}.new")
    fresh.unlink(missing_ok=True)
    descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)


def _certificate_of(folder: Path, name: str) -> Path:
    return folder / "peers" / f"{name}.pem"


def _publish(folder: Path, machine: Machine) -> None:
    """Write the files that processes read; last the one that makes them use the link."""
    write_private(folder / "fastdds.xml", fast_dds_profile().encode())
    write_private(folder / FILE, machine.to_json().encode())
