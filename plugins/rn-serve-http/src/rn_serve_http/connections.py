"""Connections of the HTTP server: bounded time for a request to arrive, and shares for each address and holder.

A connection is unproven until a request with a right came on it. Of those that had a second to prove themselves only a
few are kept, and the oldest gives way to the newest, so that connections which say nothing can shut nobody out. Many
that come at once and do say something are all answered.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections import Counter
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

log = logging.getLogger(__name__)
PROTOCOL_KEY = "roboneuron.transport"
"""Where the ASGI scope's `state` has the BoundedProtocol of a request."""
HEADERS_S = 5.0
"""From the first byte of a request (of a connection: from its beginning) to the end of its headers."""
BODY_S = 30.0
MOST_UNPROVEN, MOST_UNPROVEN_OF_ONE = 128, 64
MOST_YOUNG = 1024
"""Unproven connections in all, however young."""
YOUNG_S = 1.0
"""An unproven connection is left alone for this long: its request may be on its way."""
MOST, MOST_OF_ONE = 512, 128
"""Proven connections: of all holders, and of each."""
RESERVED = 8
"""So many each holder may have though all others together have the most."""


class ConnectionTable:
    """All connections of a server; used on its event loop only."""

    def __init__(self) -> None:
        self._unproven: dict[BoundedProtocol, None] = {}
        self._proven: dict[BoundedProtocol, str] = {}
        self._counts: Counter[str] = Counter()

    def add(self, connection: BoundedProtocol) -> None:
        """A connection was made; the oldest unproven one of its address, or of the busiest one, may have to go."""
        self._unproven[connection] = None
        counts = Counter(other.address for other in self._unproven)
        if counts[connection.address] > MOST_UNPROVEN_OF_ONE:
            busiest = connection.address
        elif len(self._unproven) > MOST_UNPROVEN:
            busiest = counts.most_common(1)[0][0]
        else:
            return
        silent = (other for other in self._unproven if other.address == busiest and other.is_silent)
        oldest = next(silent, connection)
        if len(self._unproven) <= MOST_YOUNG and (oldest is connection or oldest.age_s < YOUNG_S):
            return
        self.remove(oldest)
        oldest.drop("a newer one needs its place")

    def remove(self, connection: BoundedProtocol) -> None:
        """It is gone; nothing happens when that is known."""
        self._unproven.pop(connection, None)
        who = self._proven.pop(connection, None)
        if who is not None:
            self._counts[who] -= 1
            if not self._counts[who]:
                del self._counts[who]

    def prove(self, connection: BoundedProtocol, who: str, *, is_stop: bool = False) -> bool:
        """Whether a request of `who` is served: it came on a connection that is, or is now, one of its share.

        Args:
            connection: where it came from.
            who: its holder.
            is_stop: serve it however many there are.
        """
        if self._proven.get(connection) != who:
            if self._is_full(who) and not self._drop_idle(who, connection) and not is_stop:
                return False
            self.remove(connection)
            self._counts[who] += 1
        self._proven.pop(connection, None)
        self._proven[connection] = who  # the last used is the last to go
        return True

    def _is_full(self, who: str) -> bool:
        count = self._counts[who]
        return count >= MOST_OF_ONE or (len(self._proven) >= MOST and count >= RESERVED)

    def _drop_idle(self, who: str, keep: BoundedProtocol) -> bool:
        for other, holder in self._proven.items():
            if holder == who and other is not keep and other.is_idle:
                self.remove(other)
                other.drop("a newer one of its holder needs its place")
                return True
        return False


class BoundedProtocol(H11Protocol):
    """HTTP/1.1 of uvicorn, known to a ConnectionTable, and closed when a request does not arrive in time."""

    def __init__(self, table: ConnectionTable, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.app_state = {**self.app_state, PROTOCOL_KEY: self}
        self.table = table
        self.address = ""
        self._made_s = 0.0
        self.peer: str | None = None
        """Its client's process, once that was asked."""
        self._timer: asyncio.TimerHandle | None = None
        self._waits_for: Any = None

    @property
    def age_s(self) -> float:
        """Time since it was made [s]."""
        return self.loop.time() - self._made_s

    @property
    def is_silent(self) -> bool:
        """No request has arrived on it."""
        return self.cycle is None

    @property
    def is_idle(self) -> bool:
        """No request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See asyncio."""
        super().connection_made(transport)
        self._made_s = self.loop.time()
        self.address = _network(self.client[0] if self.client else "")
        self.table.add(self)
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
        """Close it at once."""
        if not self.transport.is_closing():
            log.debug("A connection from %s is closed: %s.", self.address, why)
            self.transport.abort()

    def _look(self) -> None:
        state = self.conn.their_state
        has_begun = state is h11.SEND_BODY or (state is h11.IDLE and bool(self.conn.trailing_data[0]))
        self._wait_for(state if has_begun else None)

    def _wait_for(self, state: Any) -> None:
        """Begin to wait for the end of headers or body; goes on waiting where it does already."""
        if state is self._waits_for:
            return
        self._waits_for = state
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if state is not None:
            limit_s = HEADERS_S if state is h11.IDLE else BODY_S
            self._timer = self.loop.call_later(limit_s, self.drop, f"no whole request within {limit_s:g} s")


def _network(address: str) -> str:
    """The address; of IPv6 the /64 network, of which one machine may have every address."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if found.version == 4 or found.is_loopback:
        return str(found)
    return str(ipaddress.ip_network((found, 64), strict=False))
