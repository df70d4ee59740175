"""This machine's key and the certificates that it trusts; the only module that writes them.

Each machine signs its own certificate and trusts exactly those of its peers: there is no
authority, and removing an entry revokes a machine. They do not expire, so that no robot stops on a
day that nobody thought of, or because its clock is wrong.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from rn_link.machine import FILE, IDENTITY, Machine, Peer, check_name, read_machine
from roboneuron import ConfigurationError, foreign

_SINCE = datetime(2000, 1, 1, tzinfo=UTC)
_FOR_EVER = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)
"""No end of validity. Source: RFC 5280, 4.1.2.5."""


def new_identity() -> str:
    """Return a new self-signed certificate and its key (P-256), which has no password because
    modules start without a person; PEM.
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
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return certificate.public_bytes(serialization.Encoding.PEM).decode() + private.decode()


def to_certificate(text: str) -> str:
    """Return the first certificate of a PEM text, and nothing else of it; raises ValueError."""
    found = x509.load_pem_x509_certificate(text.encode())
    return found.public_bytes(serialization.Encoding.PEM).decode()


def own_certificate(folder: Path) -> str:
    """Return this machine's certificate (PEM), without its key."""
    return to_certificate((folder / IDENTITY).read_text(encoding="ascii"))


def check_no_link(folder: Path) -> None:
    """Raise ConfigurationError if this machine has a link."""
    found = read_machine(folder)
    if found is not None:
        raise ConfigurationError(
            f"This machine is the {found.role} {found.name} of a link already.",
            hint="Type `roboneuron link remove --all` first, if the link is no longer needed.",
        )


def make_machine(folder: Path, machine: Machine, identity: str) -> None:
    """Store this machine's part of a link.

    Raises:
        ConfigurationError: it has one, or the name cannot be used.
    """
    for name in (machine.name, *machine.peers):
        check_name(name)
    check_no_link(folder)
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    foreign.write_private(folder / IDENTITY, identity)
    # last the file that makes processes use the link
    _store(folder, machine)


def check_new_peer(folder: Path, name: str) -> Machine:
    """Return this machine's part of the link, if a machine of that name can be added.

    Raises:
        ConfigurationError: this machine has no link, has a hub, or the name is taken.
    """
    machine = read_machine(folder)
    if machine is None:
        raise ConfigurationError(
            "This machine has no link.",
            hint="Type `roboneuron link init` first, on the robot's machine.",
        )
    if machine.role == "member":
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


def add_peer(folder: Path, name: str, peer: Peer) -> None:
    """Let this hub trust a machine; raises as `check_new_peer`."""
    machine = check_new_peer(folder, name)
    _store(folder, replace(machine, peers={**machine.peers, name: peer}))


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
    else:
        left = {other: peer for other, peer in machine.peers.items() if other != name}
        _store(folder, replace(machine, peers=left))


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


def _store(folder: Path, machine: Machine) -> None:
    foreign.write_private(folder / FILE, machine.to_json())
