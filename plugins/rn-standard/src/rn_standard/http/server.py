"""The server over streamable HTTP: one MCP server for all clients, however many sessions there
are.
"""

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
from rn_standard.http.tokens import TokenTable, shows_right
from roboneuron import __version__
from roboneuron.feature import Events, Holder

log = logging.getLogger(__name__)
PATH = "/mcp"
_KEEP_ALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 5000}
"""Socket options: s, s, probes, ms. A silent peer is gone after 5 s."""


def make_server(
    server: Server[Any],
    options: HttpOptions,
    rules: HostRules,
    tokens: TokenTable,
    events: Events,
) -> BoundedServer:
    """The HTTP server around an MCP server; `serve` it with a socket.

    Args:
        events: told who has something open, and which client without a token has ended its session.
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
        # AccessMiddleware does it, because the SDK compares how the text begins: "robot.lan:evil"
        # would pass, "ROBOT.LAN" would not; starlette's TrustedHostMiddleware knows no IPv6
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
    """A socket bound to the configured address, on which stops come through whoever else connects.

    Raises:
        ConfigurationError: as `bind`.
    """
    listener = bind("http", options.host, options.port, tokens)
    _keep_alive(listener)
    return BoundedListener(listener, stop_bounds(), partial(shows_right, tokens))


def _keep_alive(listener: socket.socket) -> None:
    """Notice within seconds that a client's machine or cable is gone; connections inherit it where
    that is known.
    """
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEP_ALIVE.items():
        if hasattr(socket, name):
            listener.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class _HttpServer(BoundedServer):
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Say where it serves once it does."""
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
