"""TLS between the machines of the link: each side must send a certificate of the issuer that the
other trusts.

Standard library only, like all imports of the relay.
"""

from __future__ import annotations

import ssl
from datetime import UTC, datetime
from pathlib import Path

from rn_link.machine import Machine


def tls_context(machine: Machine, folder: Path, peer: str) -> ssl.SSLContext:
    """Return the TLS context for `peer`: the hub connects, members listen.

    Raises:
        OSError: key or certificates cannot be used.
    """
    connects = machine.role == "hub"
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if connects else ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    # the issuer identifies the machine: each has its own, which issues for no other
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(folder / "own.pem", folder / "own.key")
    context.load_verify_locations(folder / "peers" / f"{peer}.issuer.pem")
    return context


def valid_until(connection: ssl.SSLObject) -> datetime:
    """Expiry of the other side's certificate.

    Raises:
        ssl.SSLError: it has sent none.
    """
    certificate = connection.getpeercert()
    if not certificate:
        raise ssl.SSLError("the other side has sent no certificate")
    seconds = ssl.cert_time_to_seconds(str(certificate["notAfter"]))
    return datetime.fromtimestamp(seconds, UTC)
