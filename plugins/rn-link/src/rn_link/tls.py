"""TLS between the machines of the link: both sides show a certificate of the other's issuer.

Standard library alone, as everything that the relay imports.
"""

from __future__ import annotations

import ssl
from datetime import UTC, datetime
from pathlib import Path

from rn_link.machine import Machine


def tls_context(machine: Machine, folder: Path, peer: str) -> ssl.SSLContext:
    """Return what this machine talks to `peer` with: the hub connects, members listen.

    Raises:
        OSError: key or certificates cannot be used.
    """
    connects = machine.role == "hub"
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if connects else ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    # the issuer names the machine: each has one of its own, which issues for nobody else
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(folder / "own.pem", folder / "own.key")
    context.load_verify_locations(folder / "peers" / f"{peer}.issuer.pem")
    return context


def valid_until(connection: ssl.SSLObject) -> datetime:
    """When the certificate of the other side expires.

    Raises:
        ssl.SSLError: it has shown none.
    """
    certificate = connection.getpeercert()
    if not certificate:
        raise ssl.SSLError("the other side has shown no certificate")
    seconds = ssl.cert_time_to_seconds(str(certificate["notAfter"]))
    return datetime.fromtimestamp(seconds, UTC)
