"""Connections of the HTTP server: bounded time for a request to arrive, and a share for each
holder.

A connection is unproven until it has carried an authorised request. See `BoundedListener` for
those.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from rn_standard.http.addresses import network_of
from rn_standard.http.listener import BoundedListener, handle_limit

log = logging.getLogger(__name__)
PROTOCOL_KEY = "roboneuron.transport"
"""Key of a request's BoundedProtocol in the ASGI scope's `state`."""
HEADERS_S = 5.0
"""Timeout from the first byte of a request (or from the start of a connection) to the end of its
headers.
"""
BODY_S = 30.0
MOST, MOST_OF_ONE = 512, 128
"""Maximum number of proven connections, of all holders and of each; at most a quarter and an eighth
of the process' handles.
"""
RESERVED = 8
"""Number of connections guaranteed to each holder even if all others together have the maximum."""


class ConnectionTable:
    """All connections of a server; used on its event loop only."""

    def __init__(self) -> None:
        self._proven: dict[BoundedProtocol, str] = {}
        self._counts: Counter[str] = Counter()
        self._limit = handle_limit()
        self.listeners: list[BoundedListener] = []
        """Listeners to be notified of proven connections."""

    def remove(self, connection: BoundedProtocol) -> None:
        """Remove a closed connection; no effect if already removed."""
        who = self._proven.pop(connection, None)
        if who is not None:
            self._counts[who] -= 1
            if not self._counts[who]:
                del self._counts[who]

    def keep(self, connection: BoundedProtocol) -> None:
        """Protect a connection from being dropped in favour of unproven ones."""
        for listener in self.listeners:
            if connection.client is not None:
                listener.prove(connection.client)

    def prove(self, connection: BoundedProtocol, who: str, *, is_stop: bool = False) -> bool:
        """Mark a connection as proven; return True if a request of `who` on it may be served within
        its share.

        Args:
            connection: connection of the request.
            who: its holder.
            is_stop: serve it regardless of the number of connections.
        """
        if self._proven.get(connection) != who:
            if self._is_full(who) and not self._drop_idle(who, connection) and not is_stop:
                return False
            self.remove(connection)
            self._counts[who] += 1
        self._proven.pop(connection, None)
        self._proven[connection] = who  # the most recently used one is dropped last
        self.keep(connection)
        return True

    def _is_full(self, who: str) -> bool:
        count = self._counts[who]
        most, most_of_one = min(MOST, self._limit // 4), min(MOST_OF_ONE, self._limit // 8)
        return count >= most_of_one or (len(self._proven) >= most and count >= RESERVED)

    def _drop_idle(self, who: str, keep: BoundedProtocol) -> bool:
        for other, holder in self._proven.items():
            if holder == who and other is not keep and other.is_idle:
                self.remove(other)
                other.drop("a newer one of its holder needs its place")
                return True
        return False


class BoundedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 protocol, registered in a ConnectionTable, and closed when a request does
    not arrive in time.
    """

    def __init__(self, table: ConnectionTable, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.app_state = {**self.app_state, PROTOCOL_KEY: self}
        self.table = table
        self.address = ""
        self.peer: str | None = None
        """Process of its client, once determined."""
        self._timer: asyncio.TimerHandle | None = None
        self._waits_for: object = None

    @property
    def is_idle(self) -> bool:
        """True if no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See asyncio."""
        super().connection_made(transport)
        self.address = network_of(self.client[0] if self.client else "")
        self._wait_for(h11.IDLE)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio."""
        self._wait_for(None)
        self.table.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See asyncio."""
        super().data_received(data)
        self._look()

    def on_response_complete(self) -> None:
        """See uvicorn, which closes an idle connection after five seconds."""
        super().on_response_complete()
        self._wait_for(None)
        self._look()

    def drop(self, why: str) -> None:
        """Close the connection at once."""
        if not self.transport.is_closing():
            log.debug("A connection from %s is closed: %s.", self.address, why)
            self.transport.abort()

    def _look(self) -> None:
        state = self.conn.their_state
        has_begun = state is h11.SEND_BODY or (
            state is h11.IDLE and bool(self.conn.trailing_data[0])
        )
        self._wait_for(state if has_begun else None)

    def _wait_for(self, state: object) -> None:
        """Start the timeout for headers or body, unless it is already running."""
        if state is self._waits_for:
            return
        self._waits_for = state
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if state is not None:
            limit_s = HEADERS_S if state is h11.IDLE else BODY_S
            self._timer = self.loop.call_later(
                limit_s, self.drop, f"no whole request within {limit_s:g} s"
            )
