"""The server over streamable HTTP: one Application for all clients, however many sessions there are."""

from __future__ import annotations

import ipaddress
import logging
import os
import signal
import socket
from asyncio import get_running_loop
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from typing import Any, cast

import anyio
import uvicorn
from mcp.server.transport_security import TransportSecuritySettings

from roboneuron import __version__
from roboneuron.config import Config, ServerConfig
from roboneuron.errors import ConfigurationError
from roboneuron.server.access import local_client
from roboneuron.server.app import Application
from roboneuron.server.http_border import Border, session_name
from roboneuron.server.http_connections import BoundedProtocol, ConnectionTable
from roboneuron.server.http_origin import HostRules
from roboneuron.server.http_sessions import IDLE_S, MOST_SESSIONS, MOST_SESSIONS_OF_ONE, Sessions, note_handled
from roboneuron.server.sections import check_configuration
from roboneuron.server.tokens import TokenFiles, TokenTable

log = logging.getLogger(__name__)
PATH = "/mcp"
_LEAVE_S = 1
"""Open streams get this long when the server ends; then they are cut."""
_KEEP_ALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 5000}
"""Socket options: s, s, probes, ms. A silent peer is gone after 5 s."""


def serve_http(config: Config) -> None:
    """Serve clients until SIGTERM or SIGINT comes; then stop everything.

    Raises:
        ConfigurationError, PlanningError: the configuration names what is not installed or does not fit, a token is
            missing, or the address cannot be used.
    """
    section = config.server
    tokens = TokenFiles(section.tokens, os.environ)
    rules = HostRules(section)
    with listen(section, tokens) as listener:
        application = Application(config)
        try:
            check_configuration(config, application.plugins.current())
            server = make_server(application, rules, tokens)
            application.loop.emergency_stop.press_on_signal(config.namespace)
            application.open()
            anyio.run(_serve, application, server, listener)
        finally:
            application.close()


def make_server(application: Application, rules: HostRules, tokens: TokenTable) -> uvicorn.Server:
    """The HTTP server of an application; `serve` it with a socket."""
    section = application.loop.config.server

    def release(session: str) -> None:
        """A client without a token operates no more once its session ended."""
        application.operating.release(local_client(session_name(session)).who)

    inner = application.server.streamable_http_app(
        streamable_http_path=PATH,
        max_request_body_size=section.max_request_bytes,
        session_idle_timeout=IDLE_S,
        max_sessions=MOST_SESSIONS,
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),  # the border's task
    )
    application.server.middleware.append(note_handled)
    most = MOST_SESSIONS_OF_ONE if tokens else MOST_SESSIONS
    connections = ConnectionTable()
    return _Server(
        uvicorn.Config(
            Border(Sessions(inner, section.max_request_bytes, most, release), rules, tokens, connections),
            http=cast(Any, partial(BoundedProtocol, connections)),
            log_config=None,
            access_log=False,
            lifespan="on",
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=_LEAVE_S,
            ws="none",
        )
    )


def listen(section: ServerConfig, tokens: TokenTable) -> socket.socket:
    """A socket bound to the configured address.

    Raises:
        ConfigurationError: the address is not loopback and there are no tokens, or it cannot be bound.
    """
    try:
        found = socket.getaddrinfo(section.host, section.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise ConfigurationError(f"host = {section.host!r} is no address of this machine: {error}.") from error
    family, kind, protocol, _, address = found[0]
    if not ipaddress.ip_address(str(address[0]).partition("%")[0]).is_loopback and not tokens:
        raise ConfigurationError(
            f"host = {section.host!r} can be reached from other machines, and there is no token: anybody could move "
            "the robot.",
            hint="Add [[server.tokens]] with name, role and variable or file, or listen on 127.0.0.1.",
        )
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _keep_alive(listener)
        listener.bind(address)
    except OSError as error:
        listener.close()
        raise ConfigurationError(
            f"Port {section.port} of {section.host} cannot be used: {error.strerror}.",
            hint="Does another server run? Choose another --port.",
        ) from error
    return listener


def _keep_alive(listener: socket.socket) -> None:
    """Notice within seconds that a client's machine or cable is gone; connections inherit it where that is known."""
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEP_ALIVE.items():
        if hasattr(socket, name):
            listener.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class _Server(uvicorn.Server):
    """Leaves signals to us: uvicorn would raise them again and end the process before the modules are stopped."""

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Say where it serves once it does."""
        await super().startup(sockets)
        for listener in sockets or ():
            host, port = listener.getsockname()[:2]
            shown = f"[{host}]" if ":" in host else host
            log.info("RoboNeuron %s serves MCP on http://%s:%d%s, pid %d.", __version__, shown, port, PATH, os.getpid())


async def _serve(application: Application, server: uvicorn.Server, listener: socket.socket) -> None:
    application.notices.attach(get_running_loop())

    async def leave_on_signal() -> None:
        with anyio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:
            async for number in signals:
                log.info("Received %s: stopping everything.", signal.Signals(number).name)
                server.should_exit = True
                return

    async with anyio.create_task_group() as group:
        group.start_soon(leave_on_signal)
        group.start_soon(application.settle)
        await server.serve(sockets=[listener])
        group.cancel_scope.cancel()
