"""TLS between the machines of the link: each side must show the certificate that the other stores.

Standard library only, like all imports of the relay.
"""

from __future__ import annotations

import ssl
from asyncio import StreamWriter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rn_link.machine import IDENTITY, Machine
from roboneuron import ConfigurationError

MOST_HANDSHAKES = 64


def tls_context(machine: Machine, folder: Path, peer: str) -> ssl.SSLContext:
    """Return the TLS context for connections with `peer`: the hub connects, members listen.

    Raises:
        ConfigurationError: key or certificates cannot be used, or others may use the key.
    """
    is_hub = machine.role == "hub"
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if is_hub else ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    # the stored certificate identifies the machine, not a name in it
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED
    try:
        for path in (folder, folder / IDENTITY):
            mode = path.stat().st_mode & 0o777
            if mode & 0o077:
                raise PermissionError(
                    f"others may read or replace {path} (mode {mode:o}); if nobody has, type "
                    f"`chmod go= {path}`, else pair the machine again"
                )
        context.load_cert_chain(folder / IDENTITY)
        context.load_verify_locations(cadata=machine.peers[peer].certificate)
    except (OSError, ValueError) as error:  # an empty certificate is a ValueError
        raise ConfigurationError(
            f"The keys for {peer} cannot be used: {error}.",
            hint=f"Check {folder / IDENTITY}, or pair {peer} again with `roboneuron link`.",
        ) from error
    return context


class Handshakes:
    """Connections to one listener whose other side has not shown who it is; of more than
    MOST_HANDSHAKES the oldest ones are ended, so that they keep no other out.
    """

    def __init__(self) -> None:
        self._writers: list[StreamWriter] = []

    @contextmanager
    def begun(self, writer: StreamWriter) -> Iterator[None]:
        """Count a connection within this context."""
        self._writers.append(writer)
        for oldest in self._writers[:-MOST_HANDSHAKES]:
            oldest.transport.abort()
        try:
            yield
        finally:
            self._writers.remove(writer)

    def end(self) -> None:
        """End all of them."""
        for writer in self._writers:
            writer.transport.abort()
