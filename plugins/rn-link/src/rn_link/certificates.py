"""Keys and certificates of the machines.

Each machine's certificate has its own issuer, and a machine trusts exactly the issuers of its
peers. Fast DDS has no option for revocation lists, so removing an issuer revokes a machine.
"""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rn_link.machine import Machine, Role
from roboneuron import ConfigurationError

DAYS = 365
MOST_DAYS = 3650
"""Validity of an issuer, which limits that of its certificates."""
_CLOCKS = timedelta(days=1)
"""Tolerated difference between the clocks of two machines."""
_PURPOSES = {"hub": ExtendedKeyUsageOID.CLIENT_AUTH, "member": ExtendedKeyUsageOID.SERVER_AUTH}
"""The hub connects and members listen, so neither can act in the other's role."""


class Issuer(NamedTuple):
    """Issuer of one machine's certificate."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


def new_key() -> ec.EllipticCurvePrivateKey:
    """Return a new key (P-256)."""
    return ec.generate_private_key(ec.SECP256R1())


def new_issuer(name: str, now: datetime) -> Issuer:
    """Return a new issuer for the machine called `name`."""
    key = new_key()
    subject = _name(f"RoboNeuron link issuer of {name}")
    usage = dict.fromkeys(
        (
            "digital_signature",
            "content_commitment",
            "key_encipherment",
            "data_encipherment",
            "key_agreement",
            "crl_sign",
            "encipher_only",
            "decipher_only",
        ),
        False,
    )
    certificate = (
        _builder(subject, subject, key.public_key(), now, MOST_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, **usage), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Issuer(key, certificate)


def issue(
    issuer: Issuer, name: str, role: Role, key: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.Certificate:
    """Return the certificate of a machine, valid for `days` from `now`.

    Raises:
        ConfigurationError: it would outlive its issuer.
    """
    left = issuer.certificate.not_valid_after_utc - now
    if not 1 <= days <= left.days:
        raise ConfigurationError(
            f"A certificate of this machine cannot be valid for {days} days.",
            hint=f"Name 1 to {left.days} days.",
        )
    return (
        _builder(_name(name), issuer.certificate.subject, key, now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([_PURPOSES[role]]), critical=True)
        .sign(issuer.key, hashes.SHA256())
    )


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    now: datetime,
    days: int,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS)
        .not_valid_after(now + timedelta(days=days))
    )


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def to_pem(certificate: x509.Certificate) -> bytes:
    """PEM of a certificate, for files."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_to_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """PEM of a key, for files; without a password, because modules start without a person."""
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def read_certificate(path: Path) -> x509.Certificate:
    """Read the certificate in a file.

    Raises:
        ConfigurationError: it is missing or invalid.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{path} holds no certificate: {error}.",
            hint="Pair the machine again with `roboneuron link`.",
        ) from error


def exposed_keys(folder: Path) -> list[Path]:
    """Keys of this machine that others may read or replace."""
    keys = (folder / "ca.key", folder / "own.key")
    return [key for key in keys if key.exists() and key.stat().st_mode & 0o077]


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a key of this machine.

    Raises:
        ConfigurationError: it is missing or invalid, or readable by others.
    """
    try:
        mode = path.stat().st_mode
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"{path} holds no key: {error}.", hint="Pair the machine again with `roboneuron link`."
        ) from error
    if mode & 0o077:
        raise ConfigurationError(
            f"Others may read or replace the key {path} (mode {mode & 0o777:o}).",
            hint=f"Pair the machine again; if nobody has read it, type `chmod 600 {path}`.",
        )
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigurationError(
            f"{path} holds a key of another kind.",
            hint="Pair the machine again with `roboneuron link`.",
        )
    return key


def expiries(machine: Machine, folder: Path) -> dict[str, datetime]:
    """Expiry of the certificates known to this machine, by name: its own, and on the hub those of
    the members.
    """
    files = {machine.name: folder / "own.pem"}
    if machine.role == "hub":
        files |= {name: folder / "peers" / f"{name}.pem" for name in machine.peers}
    return {name: read_certificate(path).not_valid_after_utc for name, path in files.items()}


def check_in_time(machine: Machine, folder: Path, now: datetime | None = None) -> None:
    """Check this machine's key and certificate.

    Raises:
        ConfigurationError: the certificate has expired, or the key is missing or readable by
            others.
    """
    read_key(folder / "own.key")
    expiry = read_certificate(folder / "own.pem").not_valid_after_utc
    if expiry <= (now or datetime.now(UTC)):
        hub = next(iter(machine.peers), "the hub")
        raise ConfigurationError(
            f"The certificate of this machine expired on {expiry:%Y-%m-%d}.",
            hint=(
                "Type `roboneuron link init` for a new one."
                if machine.role == "hub"
                else f"Type `roboneuron link add {machine.name}` on {hub}, then `roboneuron link "
                "init --join ADDRESS` here."
            ),
        )


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
