"""The server: openpi's protocol over a websocket, with bounds on time, size and connections.

It sends the metadata first, then one answer for each request. Errors are sent as a text frame, as
openpi does, and close only that connection; for an unexpected error the client receives no details.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import ssl
from collections.abc import Callable, Sequence
from contextlib import suppress
from http import HTTPStatus
from typing import ClassVar

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from rn_backend_openpi.key import is_loopback, read_key
from rn_backend_openpi.server_options import ServerOptions
from rn_backend_openpi.serving import PolicyRequest, ServedPolicy
from rn_backend_openpi.wire import MOST_BYTES, Value, pack
from rn_backend_shared.admission import crowded
from rn_backend_shared.batching import Answer
from rn_backend_shared.security import client_of
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    NotReadyError,
    RoboNeuronError,
    UngroundedError,
    UnsafeError,
)

_HANDSHAKE_S = 5.0
"""Longest opening handshake, TLS included."""
_STRANGERS = 64
"""Connections beyond `clients` that may be in their handshake at the same time."""
_GRACE_S = 0.5
"""Time after its deadline at which an answer counts as late."""
_CLOSE_S = 1.0
_TOLD = (InvalidInputError, UngroundedError, UnsafeError, NotReadyError)
"""Errors of one observation, whose text is sent to the client; others may contain paths of the
server.
"""
LOOPBACK = "127.0.0.1"
log = logging.getLogger(__name__)


class OpenpiServer:
    """Serves one policy.

    Args:
        policy: loaded policy.
        options: options of the server.
        key: key that clients must send; None admits everyone.
    """

    def __init__(self, policy: ServedPolicy, options: ServerOptions, key: str | None) -> None:
        self._policy, self._options, self._key = policy, options, key
        self._connections: dict[_Connection, None] = {}
        self._clients: dict[_Connection, None] = {}
        policy.clients = lambda: max(1, len(self._clients))

    async def open(self, host: str, port: int, tls: ssl.SSLContext | None) -> Server:
        """Listen. Raises OSError when the address cannot be used."""
        # websockets logs a traceback for each failed handshake, which could fill a disk
        strangers = logging.getLogger(f"{__name__}.strangers")
        strangers.setLevel(logging.CRITICAL)
        return await serve(
            self._handle,
            host,
            port,
            ssl=tls,
            process_request=self._admit,
            create_connection=type("_Counted", (_Connection,), {"owner": self}),
            compression=None,
            max_size=MOST_BYTES,
            max_queue=1,
            open_timeout=_HANDSHAKE_S,
            close_timeout=_CLOSE_S,
            server_header=None,
            logger=strangers,
            ssl_handshake_timeout=None if tls is None else _HANDSHAKE_S,
        )

    def entered(self, connection: _Connection) -> None:
        """Register a new connection. If there are too many, abort the one that has been in its
        handshake for longest: that of a real client takes milliseconds.
        """
        if len(self._connections) >= self._options.clients + _STRANGERS:
            oldest = next(old for old in self._connections if old not in self._clients)
            self.left(oldest)
            oldest.transport.abort()
        self._connections[connection] = None

    def left(self, connection: _Connection) -> None:
        """Remove a closed connection."""
        self._connections.pop(connection, None)
        self._clients.pop(connection, None)

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a probe, or refuse a client; returns None to accept it."""
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        if self._key is not None and not self._is_key(request.headers.get_all("Authorization")):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "")
        assert isinstance(connection, _Connection)
        if len(self._clients) >= self._options.clients and not self._make_place(connection.client):
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "")
        self._clients[connection] = None
        return None

    def _make_place(self, client: str) -> bool:
        """Close the newest connection of the client with the most connections, if that client keeps
        more than this one would have; returns True if one was closed.
        """
        greedy = crowded(client, [connection.client for connection in self._clients])
        if greedy is None:
            return False
        newest = next(one for one in reversed(self._clients) if one.client == greedy)
        log.warning("%s has most of the connections; the newest gives way.", greedy)
        self.left(newest)
        newest.transport.abort()
        return True

    def _is_key(self, given: Sequence[str]) -> bool:
        """True if these headers hold the key; in constant time."""
        told = " ".join(given).encode(errors="replace")
        return hmac.compare_digest(told, f"Api-Key {self._key}".encode())

    async def _handle(self, connection: ServerConnection) -> None:
        """Serve one client until it disconnects."""
        peer = connection.remote_address
        log.info("%s is connected.", peer)
        try:
            await self._send(connection, pack(self._policy.metadata()))
            await self._converse(connection)
        except ConnectionClosed:
            pass
        except RoboNeuronError as error:
            log.warning("%s is dropped: %s", peer, error)
            told = str(error) if isinstance(error, _TOLD) else "see the server's log."
            await self._fail(connection, f"{type(error).__name__}: {told}")
        except Exception:  # the border to one client: the others continue
            log.exception("%s is dropped.", peer)
            await self._fail(connection, "InternalError: see the server's log.")
        log.info("%s is gone.", peer)

    async def _converse(self, connection: ServerConnection) -> None:
        loop = asyncio.get_running_loop()
        previous_ms: float | None = None
        while True:
            try:
                data = await asyncio.wait_for(connection.recv(), self._options.idle_timeout_s)
            except TimeoutError:
                await connection.close(CloseCode.GOING_AWAY, "idle")
                return
            began_s = loop.time()
            question = await asyncio.to_thread(self._policy.read, data)
            if question is None:
                await self._send(connection, pack({"status": "reset successful"}))
                continue
            reply = await self._answer(question, connection)
            timing: dict[str, float] = {"infer_ms": (loop.time() - began_s) * 1e3}
            if previous_ms is not None:
                timing["prev_total_ms"] = previous_ms
            reply["server_timing"] = timing
            await self._send(connection, pack(reply))
            previous_ms = (loop.time() - began_s) * 1e3

    async def _answer(
        self, question: PolicyRequest, connection: ServerConnection
    ) -> dict[str, Value]:
        """The reply to a request; raises RoboNeuronError as the backend does."""
        loop = asyncio.get_running_loop()
        told: asyncio.Future[Answer] = loop.create_future()

        def settle(answer: Answer) -> None:
            if not told.done():
                told.set_result(answer)

        def tell(answer: Answer) -> None:
            with suppress(RuntimeError):  # the server has ended: the answer has no receiver
                loop.call_soon_threadsafe(settle, answer)

        assert isinstance(connection, _Connection)
        self._policy.submit(question, tell, client=connection.client, connection=connection)
        try:
            answer = await asyncio.wait_for(told, question.left_s + _GRACE_S)
        except TimeoutError as error:
            raise NotReadyError("The model gave no answer before the deadline.") from error
        return await asyncio.to_thread(self._policy.reply, answer, question)

    async def _send(self, connection: ServerConnection, data: bytes | str) -> None:
        """Send one frame; a client that does not read is disconnected, so it blocks nobody.

        Raises:
            ConnectionClosed: the client is disconnected.
        """
        try:
            await asyncio.wait_for(connection.send(data), self._options.send_timeout_s)
        except TimeoutError:
            log.warning("%s does not read; it is dropped.", connection.remote_address)
            connection.transport.abort()
            await connection.wait_closed()
            raise ConnectionClosed(None, None) from None

    async def _fail(self, connection: ServerConnection, text: str) -> None:
        try:
            await self._send(connection, text)
            await connection.close(CloseCode.INTERNAL_ERROR, "see the text frame before")
        except ConnectionClosed:
            pass


class _Connection(ServerConnection):
    """A connection that is counted from the start of its handshake.

    Attributes:
        owner: the server; each server has a subclass of its own.
        client: identifies the peer by its address, because all clients use the same key.
    """

    owner: ClassVar[OpenpiServer]
    client = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.client = client_of(str(transport.get_extra_info("peername", ("",))[0]))
        self.owner.entered(self)
        super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.owner.left(self)
        super().connection_lost(exc)


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
    listening: Callable[[int], None],
    until: asyncio.Event,
) -> None:
    """Serve until the event is set; calls `listening` with the port.

    Raises:
        ConfigurationError: the address cannot be used.
    """
    host, port = address
    try:
        opened = await server.open(host, port, tls)
    except OSError as error:
        raise ConfigurationError(
            f"The server cannot listen on {host}:{port}: {error.strerror or error}.",
            hint="Choose another --host or --port.",
        ) from error
    async with opened:
        listening(next(iter(opened.sockets)).getsockname()[1])
        await until.wait()
