"""Detection of connections that are lost during a call."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from starlette.types import Message, Receive

log = logging.getLogger(__name__)


class RequestConnection:
    """The connection of one HTTP request; used on the event loop only."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._listeners: list[Callable[[], object]] = []
        self._is_lost = False

    async def receive(self) -> Message:
        """The ASGI channel of the application; a streamed response always listens on it."""
        message = await self._receive()
        if message["type"] == "http.disconnect" and not self._is_lost:
            self._is_lost = True
            if self._listeners:
                log.warning("A client was lost while its call was at work.")
            for listener in self._listeners:
                listener()
        return message

    @contextmanager
    def watched(self, listener: Callable[[], object]) -> Iterator[None]:
        """Call `listener` if the connection is lost within the block, or was lost before."""
        self._listeners.append(listener)
        try:
            if self._is_lost:
                listener()
            yield
        finally:
            self._listeners.remove(listener)
