"""TLS between the machines of the link: each side must show the certificate that the other stores.

Standard library only, like all imports of the relay.
"""

from __future__ import annotations

import ssl
from pathlib import Path

from rn_link.machine import Machine


def check_private(folder: Path) -> None:
    """Check who may use this machine's key.

    Raises:
        OSError: others may read or replace it, or it is missing.
    """
    for path in (folder, folder / "own.key"):
        mode = path.stat().st_mode & 0o777
        if mode & 0o077:
            raise PermissionError(
                f"others may read or replace {path} (mode {mode:o}); if nobody has, type "
                f"`chmod go= {path}`, else pair the machine again"
            )


def own_context(machine: Machine, folder: Path) -> ssl.SSLContext:
    """Return a TLS context with this machine's key, which trusts nobody yet; the hub connects,
    members listen.

    Raises:
        OSError: key or certificate cannot be used, or others may use them.
    """
    check_private(folder)
    is_hub = machine.role == "hub"
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if is_hub else ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    # the stored certificate identifies the machine, not a name in it
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(folder / "own.pem", folder / "own.key")
    return context


def tls_context(machine: Machine, folder: Path, peer: str) -> ssl.SSLContext:
    """Return the TLS context for connections with `peer`.

    Raises:
        OSError: key or certificates cannot be used, or others may use them.
    """
    context = own_context(machine, folder)
    context.load_verify_locations(folder / "peers" / f"{peer}.pem")
    return context
