"""The server over streamable HTTP: one MCP server for all clients and sessions."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from mcp.server import Server
from mcp.server.transport_security import TransportSecuritySettings

from rn_standard.http.addresses import bind
from rn_standard.http.authentication import session_name
from rn_standard.http.bounded_server import BoundedServer
from rn_standard.http.connections import ConnectionTable
from rn_standard.http.listener import BoundedListener, stop_bounds
from rn_standard.http.middleware import AccessMiddleware
from rn_standard.http.options import HttpOptions
from rn_standard.http.origins import HostRules
from rn_standard.http.sessions import (
    IDLE_S,
    MOST_SESSIONS,
    MOST_SESSIONS_OF_ONE,
    Sessions,
    note_handled,
)
from rn_standard.http.tokens import TokenTable, shown_holder
from roboneuron import __version__
from roboneuron.feature import Events, Holder

log = logging.getLogger(__name__)
PATH = "/mcp"
_KEEP_ALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 5000}
"""Socket options: s, s, probes, ms. A silent peer is detected after 5 s."""


def make_server(
    server: Server[Any],
    options: HttpOptions,
    rules: HostRules,
    tokens: TokenTable,
    events: Events,
) -> BoundedServer:
    """Create the HTTP server around an MCP server; `serve` it with a socket.

    Args:
        events: receive the opening and closing of requests, and the end of a tokenless client's
            session.
    """

    def release(session: str) -> None:
        events.client.tell(Holder.local(session_name(session)).who, False)

    @contextmanager
    def present(who: str) -> Iterator[None]:
        events.presence.tell(who, 1)
        try:
            yield
        finally:
            events.presence.tell(who, -1)

    inner = server.streamable_http_app(
        streamable_http_path=PATH,
        max_request_body_size=options.max_request_bytes,
        session_idle_timeout=IDLE_S,
        max_sessions=MOST_SESSIONS,
        # AccessMiddleware checks them, because the SDK compares prefixes: "robot.lan:evil" would
        # pass, "ROBOT.LAN" would not; starlette's TrustedHostMiddleware does not support IPv6
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),
    )
    server.middleware.append(note_handled)
    most = MOST_SESSIONS_OF_ONE if tokens else MOST_SESSIONS
    connections = ConnectionTable()
    sessions = Sessions(inner, options.max_request_bytes, most, release)
    return _HttpServer(
        AccessMiddleware(sessions, rules, tokens, connections, present), connections, lifespan="on"
    )


def listen(options: HttpOptions, tokens: TokenTable) -> BoundedListener:
    """Create a socket bound to the configured address, on which emergency stops arrive whatever
    other clients connect.

    Raises:
        ConfigurationError: as `bind`.
    """
    listener = bind("http", options.host, options.port, tokens)
    _keep_alive(listener)
    return BoundedListener(listener, stop_bounds(), partial(shown_holder, tokens))


def _keep_alive(listener: socket.socket) -> None:
    """Detect within seconds that a client's machine or cable has failed; connections inherit it
    where supported.
    """
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEP_ALIVE.items():
        if hasattr(socket, name):
            listener.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class _HttpServer(BoundedServer):
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Log the address once the server is running."""
        await super().startup(sockets)
        for listener in sockets or ():
            host, port = listener.getsockname()[:2]
            shown = f"[{host}]" if ":" in host else host
            log.info(
                "RoboNeuron %s serves MCP on http://%s:%d%s, pid %d.",
                __version__,
                shown,
                port,
                PATH,
                os.getpid(),
            )
