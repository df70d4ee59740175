"""Websocket connections of a server, with bounds on time, size and number."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import ssl
from asyncio.trsock import TransportSocket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from http import HTTPStatus
from typing import Any, ClassVar

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.connection import Connection
from websockets.asyncio.server import Server, ServerConnection, serve, unix_serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.protocol import State

from rn_backend_openpi.security import tune
from rn_backend_openpi.wire import MOST_BYTES
from roboneuron import ConfigurationError

HANDSHAKE_S = 5.0
"""Longest opening handshake, TLS included."""
SEND_S = 2.0
"""Time after which a client that does not read is disconnected."""
STRANGERS = 64
"""Connections beyond the clients that may be in their handshake at the same time."""
_CLOSE_S = 1.0
_SILENT_S = 5.0
_BACKLOG = 1024
Answer = tuple[HTTPStatus, str]
"""Status and text of an answer of HTTP."""
Handle = Callable[[ServerConnection], Awaitable[None]]
Admit = Callable[[ServerConnection, Request], Answer | None]
"""Refuses a client; None accepts it."""
Page = Callable[[], Answer]
log = logging.getLogger(__name__)


def address_of(host: str, port: int) -> str:
    """`host:port`, with brackets for an address of IPv6."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@contextmanager
def listening(host: str, port: int, option: str) -> Iterator[list[socket.socket]]:
    """Listening sockets at every address of a host, of IPv4 and IPv6, closed after the context.

    Args:
        host: name or address; `::` means any address of both.
        port: of all sockets; 0 for a free one.
        option: key of the port in [listen], for the message.

    Raises:
        ConfigurationError: the address cannot be used.
    """
    with ExitStack() as undo:
        made: list[socket.socket] = []
        unusable = OSError("the name has no address")
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            for family, *_, place in found:
                address = (place[0], port, *place[2:])
                is_both = host == "::" and socket.has_dualstack_ipv6()
                try:
                    one = socket.create_server(
                        address, family=family, backlog=_BACKLOG, dualstack_ipv6=is_both
                    )
                except OSError as error:
                    # a name may have addresses of a family that this machine does not use
                    if error.errno not in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
                        raise
                    unusable = error
                else:
                    made.append(undo.enter_context(one))
                    port = one.getsockname()[1]
            if not made:
                raise unusable
        except OSError as error:
            raise ConfigurationError(
                f"The policy server cannot listen on {address_of(host, port)}: "
                f"{error.strerror or error}.",
                hint=f"Is another one running? Choose another host or {option} in [listen].",
            ) from error
        yield made


class Listener:
    """Accepts the clients of a server; used on its event loop.

    Args:
        handle: serves one client until it disconnects.
        most: largest number of clients; further ones are refused. With 0 there are pages only.
        admit: refuses clients.
        pages: answers to plain requests of HTTP, by path.

    Attributes:
        clients: the admitted connections, oldest first.
        refused: number of connections that ended before they were admitted, pages not counted.
    """

    def __init__(
        self,
        handle: Handle,
        *,
        most: int,
        admit: Admit = lambda connection, request: None,
        pages: Mapping[str, Page],
    ) -> None:
        self._handle, self._most, self._admit, self._pages = handle, most, admit, pages
        # accepted and in their handshake of TLS, by descriptor, oldest first
        self._begun: dict[int, socket.socket] = {}
        self._unknown: dict[CountedConnection, None] = {}
        self.clients: dict[CountedConnection, None] = {}
        self.refused = 0

    def _options(self) -> dict[str, Any]:
        # websockets logs a traceback for each failed handshake, which could fill a disk
        strangers = logging.getLogger(f"{__name__}.strangers")
        strangers.setLevel(logging.CRITICAL)
        return {
            "process_request": self._process,
            "create_connection": type("_Counted", (CountedConnection,), {"owner": self}),
            "compression": None,
            "max_size": MOST_BYTES,
            "max_queue": 1,
            "open_timeout": HANDSHAKE_S,
            "close_timeout": _CLOSE_S,
            # robots read only while they wait for an answer; TCP finds those that are gone
            "ping_interval": None,
            "server_header": None,
            "logger": strangers,
        }

    async def open(self, listening: socket.socket, tls: ssl.SSLContext | None) -> Server:
        """Accept connections of a listening socket, which the server owns from now on."""
        timeout_s = None if tls is None else HANDSHAKE_S
        return await serve(
            self._handle,
            sock=_Listening(listening, self.accepted),
            ssl=tls,
            ssl_handshake_timeout=timeout_s,
            **self._options(),
        )

    async def open_local(self, path: str) -> Server:
        """Accept connections at the path of a Unix socket. Raises OSError."""
        with suppress(FileNotFoundError):
            os.unlink(path)
        return await unix_serve(self._handle, path, backlog=_BACKLOG, **self._options())

    def accepted(self, connected: socket.socket) -> None:
        """Register a new connection before its handshake of TLS. If too many are in it, end the
        oldest of them.
        """
        self._begun = {number: one for number, one in self._begun.items() if one.fileno() == number}
        if len(self._begun) >= STRANGERS:
            oldest = self._begun.pop(next(iter(self._begun)))
            with suppress(OSError):  # it has ended already
                oldest.shutdown(socket.SHUT_RDWR)
        self._begun[connected.fileno()] = connected

    def entered(self, connection: CountedConnection, plain: TransportSocket | None) -> None:
        """Register a connection at the start of its opening handshake. If too many are in it, abort
        the oldest of them: that of a real client takes milliseconds.
        """
        if plain is not None:
            self._begun.pop(plain.fileno(), None)
        if len(self._unknown) >= STRANGERS:
            oldest = next(iter(self._unknown))
            self.left(oldest)
            oldest.transport.abort()
        self._unknown[connection] = None

    def left(self, connection: CountedConnection) -> None:
        """Remove a closed connection."""
        self.clients.pop(connection, None)
        if connection in self._unknown:
            del self._unknown[connection]
            self.refused += not connection.is_page

    async def _process(self, connection: ServerConnection, request: Request) -> Response | None:
        assert isinstance(connection, CountedConnection)
        page = self._pages.get(request.path.partition("?")[0])
        if page is not None:
            connection.is_page = True
            return connection.respond(*await asyncio.to_thread(page))
        refusal = self._admit(connection, request) if self._most else (HTTPStatus.NOT_FOUND, "")
        if refusal is None and len(self.clients) >= self._most:
            text = f"{len(self.clients)} clients are connected; no more are taken."
            refusal = HTTPStatus.SERVICE_UNAVAILABLE, text
        if refusal is not None:
            return connection.respond(*refusal)
        self._unknown.pop(connection, None)
        self.clients[connection] = None
        return None


class _Listening(socket.socket):
    """A listening socket that tells whom it accepts; takes the place of another one."""

    def __init__(self, listening: socket.socket, tell: Callable[[socket.socket], None]) -> None:
        super().__init__(fileno=listening.detach())
        self._tell = tell

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection. Raises OSError."""
        connected, address = super().accept()
        self._tell(connected)
        return connected, address


class Piped(Connection):
    """A connection that hands on what it receives to another one, unparsed, while `other` is set:
    frames of a client are valid at a server behind, and its frames at the client.

    Attributes:
        other: takes what this one receives; None for messages as usual.
        passed: called with each part that is handed on.
    """

    other: Connection | None = None
    passed: Callable[[bytes], object]

    def data_received(self, data: bytes) -> None:
        if self.other is None:
            super().data_received(data)
            return
        self.passed(data)
        self.other.transport.write(data)

    def pause_writing(self) -> None:
        super().pause_writing()
        if self.other is not None:
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        super().resume_writing()
        if self.other is not None:
            self.other.transport.resume_reading()


class PipedClient(Piped, ClientConnection):
    """The end of a server that is the client of another one."""


class CountedConnection(Piped, ServerConnection):
    """A connection that is counted from the start of its handshake.

    Attributes:
        owner: the listener; each has a subclass of its own.
        is_page: it asks for a page.
        is_early: it sent something before it was handed on.
    """

    owner: ClassVar[Listener]
    is_page = is_early = False
    _slow: asyncio.TimerHandle | None = None
    _asked = b""
    """What was received of its HTTP request."""

    def data_received(self, data: bytes) -> None:
        if self.state is State.OPEN:
            self.is_early |= self.other is None
        elif self.state is State.CONNECTING and not self.is_early:
            self._asked += data
            _, _, beyond = self._asked.partition(b"\r\n\r\n")
            self.is_early = bool(beyond)
        super().data_received(data)

    def pause_writing(self) -> None:
        super().pause_writing()
        if self.other is not None:
            self._slow = self.loop.call_later(SEND_S, drop_slow, self)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._slow is not None:
            self._slow.cancel()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        plain = transport.get_extra_info("socket")
        self.owner.entered(self, plain)
        if plain is not None and plain.family != socket.AF_UNIX:
            tune(plain, _SILENT_S)
        super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.owner.left(self)
        super().connection_lost(exc)


def drop_slow(connection: ServerConnection) -> None:
    """Disconnect a client that does not read."""
    log.warning("%s does not read; it is dropped.", connection.remote_address)
    connection.transport.abort()


async def send(connection: ServerConnection, data: bytes | str) -> None:
    """Send one message; a client that does not read is disconnected, so it blocks nobody.

    Raises:
        ConnectionClosed: the client is disconnected.
    """
    try:
        async with asyncio.timeout(SEND_S):
            await connection.send(data)
    except TimeoutError:
        drop_slow(connection)
        await connection.wait_closed()
        raise ConnectionClosed(None, None) from None
