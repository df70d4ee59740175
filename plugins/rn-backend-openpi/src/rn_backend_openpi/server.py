"""The server: openpi's protocol over a websocket, for one policy.

It sends the metadata first, then one answer for each request. Errors are sent as a text frame, as
openpi does, and close only that connection; for an unexpected error the client receives no details.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import socket
import ssl
from collections.abc import Callable
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request

from rn_backend_openpi.conversations import Patience, converse
from rn_backend_openpi.key import is_loopback, read_key
from rn_backend_openpi.listener import Listener
from rn_backend_openpi.server_options import ServerOptions
from rn_backend_openpi.serving import ServedPolicy
from roboneuron import ConfigurationError

LOOPBACK = "127.0.0.1"
_BACKLOG = 1024
log = logging.getLogger(__name__)


class OpenpiServer:
    """Serves one policy.

    Args:
        policy: loaded policy.
        options: options of the server.
        key: key that clients must send; None admits everyone.
    """

    def __init__(self, policy: ServedPolicy, options: ServerOptions, key: str | None) -> None:
        self._policy, self._key = policy, key
        self._patience = Patience(send_s=options.send_timeout_s, idle_s=options.idle_timeout_s)
        self.listener = Listener(
            self._handle,
            most=options.clients,
            admit=self._admit,
            pages={"/healthz": lambda: (HTTPStatus.OK, "OK\n")},
        )
        policy.clients = lambda: max(1, len(self.listener.clients))

    def _admit(
        self, connection: ServerConnection, request: Request
    ) -> tuple[HTTPStatus, str] | None:
        """Refuse a client without the key; compared in constant time."""
        if self._key is None:
            return None
        told = " ".join(request.headers.get_all("Authorization")).encode(errors="replace")
        if hmac.compare_digest(told, f"Api-Key {self._key}".encode()):
            return None
        return HTTPStatus.UNAUTHORIZED, ""

    async def _handle(self, connection: ServerConnection) -> None:
        peer = connection.remote_address
        log.info("%s is connected.", peer)
        await converse(connection, self._policy, self._patience)
        log.info("%s is gone.", peer)


def check_listening(host: str, options: ServerOptions) -> tuple[str | None, ssl.SSLContext | None]:
    """The key that clients must send and the TLS context, from the options.

    Args:
        host: address to listen on.
        options: options of the server.

    Raises:
        ConfigurationError: the key or the certificate cannot be read; or other machines could
            connect without a key or unencrypted, and `insecure` is not set.
    """
    key = None if options.token_file is None else read_key(options.token_file)
    tls = _tls(options)
    if is_loopback(host) or (key is not None and tls is not None):
        return key, tls
    lacks = " and ".join(
        name for name, value in (("token_file", key), ("certificate", tls)) if value is None
    )
    if not options.insecure:
        raise ConfigurationError(
            f"host = {host!r} can be reached from other machines, and there is no {lacks}: anybody "
            "could read the images and answer in the policy's place.",
            hint="Set token_file and certificate in [plugins.openpi.server], listen on 127.0.0.1, "
            "or choose insecure = true.",
        )
    log.warning("%s can be reached from other machines without %s; insecure = true.", host, lacks)
    return key, tls


def _tls(options: ServerOptions) -> ssl.SSLContext | None:
    if options.certificate is None:
        if options.certificate_key is not None:
            raise ConfigurationError("certificate_key has no use without certificate.")
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(options.certificate, options.certificate_key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigurationError(
            f"The certificate {options.certificate} cannot be used: {error}."
        ) from error
    return context


async def run_server(
    server: OpenpiServer,
    address: tuple[str, int],
    tls: ssl.SSLContext | None,
    listening_at: Callable[[int], None],
    until: asyncio.Event,
) -> None:
    """Serve until the event is set; calls `listening_at` with the port.

    Raises:
        ConfigurationError: the address cannot be used.
    """
    host, port = address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise ConfigurationError(
            f"The server cannot listen on {host}:{port}: {error.strerror or error}.",
            hint="Choose another --host or --port.",
        ) from error
    opened_port = listening.getsockname()[1]
    async with await server.listener.open(listening, tls):
        listening_at(opened_port)
        await until.wait()
