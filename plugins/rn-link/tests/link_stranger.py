"""`link_stranger.py MANNERS`: the relay, with the behaviour of a foreign node.

"plain": no TLS. "none": no certificate. "foreign" and the others: the stored certificates, and any
certificate of the other side is accepted. "careless": requests no certificate.
"""

from __future__ import annotations

import asyncio
import ssl
import sys
from pathlib import Path

from rn_link import relay, tls
from rn_link.keys import new_identity, write_private
from rn_link.machine import Machine, link_folder


def main(manners: str) -> None:
    """Run the relay."""

    def context(machine: Machine, folder: Path, peer: str) -> ssl.SSLContext | None:
        if manners == "plain":
            return None
        made = tls.tls_context(machine, folder, peer)
        made.verify_mode = ssl.CERT_NONE
        if manners == "none" and machine.role == "hub":
            bare = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            bare.check_hostname = False
            bare.verify_mode = ssl.CERT_NONE
            return bare
        if manners == "none":
            # a listening side needs one: it is self-signed
            made.load_cert_chain(*_self_signed(folder))
        return made

    relay.tls_context = context  # type: ignore[assignment]
    if manners == "plain":
        start_server = asyncio.start_server

        def start(*arguments: object, **options: object) -> object:
            if options.get("ssl") is None:
                options.pop("ssl_handshake_timeout", None)
            return start_server(*arguments, **options)  # type: ignore[arg-type]

        asyncio.start_server = start  # type: ignore[assignment]
    asyncio.run(relay.serve(link_folder()))


def _self_signed(folder: Path) -> tuple[Path, Path]:
    identity = new_identity()
    write_private(folder / "nobody.pem", identity.certificate)
    write_private(folder / "nobody.key", identity.key)
    return folder / "nobody.pem", folder / "nobody.key"


if __name__ == "__main__":
    main(sys.argv[1])
