"""uvicorn server with bounds on connections and on the time in which a request arrives."""

from __future__ import annotations

import socket
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, cast

import uvicorn
from starlette.types import ASGIApp

from rn_standard.http.connections import BoundedProtocol, ConnectionTable
from rn_standard.http.listener import BACKLOG, BoundedListener

_LEAVE_S = 1
"""Time for open streams when the server ends; then they are closed."""


class BoundedServer(uvicorn.Server):
    """uvicorn server to be used with a BoundedListener.

    It does not handle signals: uvicorn would raise them again and end the process before the
    modules are stopped.

    Args:
        app: the ASGI application.
        connections: connections of this server.
        lifespan: "on" for an application with startup and shutdown handlers.
    """

    def __init__(
        self, app: ASGIApp, connections: ConnectionTable, *, lifespan: Literal["on", "off"] = "off"
    ) -> None:
        config = uvicorn.Config(
            app,
            http=cast(Any, partial(BoundedProtocol, connections)),
            backlog=BACKLOG,
            log_config=None,
            access_log=False,
            interface="asgi3",
            lifespan=lifespan,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=_LEAVE_S,
            ws="none",
        )
        super().__init__(config)
        self._connections = connections

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """See uvicorn."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """See uvicorn."""
        self._connections.listeners += [
            one for one in sockets or () if isinstance(one, BoundedListener)
        ]
        await super().startup(sockets)
