"""Notifications of changed tools or resources for clients of both protocol eras, from any
thread.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from anyio import BrokenResourceError, ClosedResourceError
from mcp.server.context import ServerRequestContext
from mcp.server.session import ServerSession
from mcp.server.subscriptions import InMemorySubscriptionBus, ResourceUpdated, ToolsListChanged
from mcp.shared.exceptions import MCPError

log = logging.getLogger(__name__)
_MOST_SESSIONS = 64
_FIRST_WITHOUT_HANDSHAKE = "2026"
"""First revision that delivers changes only to listening clients; older ones deliver to every
session.
"""


class ToolNotices:
    """Notifications, with the clients that have listed the tools.

    Attributes:
        bus: events for clients of the 2026 revisions; give it to a `ListenHandler`.
    """

    def __init__(self) -> None:
        self.bus = InMemorySubscriptionBus()
        self._sessions: dict[int, ServerSession] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._subscribers: dict[str, dict[int, ServerSession]] = {}

    def remember(self, request: ServerRequestContext) -> None:
        """Store a client that listed the tools; called on the event loop."""
        self._loop = asyncio.get_running_loop()
        if request.protocol_version < _FIRST_WITHOUT_HANDSHAKE:
            self._sessions[id(request.session)] = request.session
            while len(self._sessions) > _MOST_SESSIONS:
                del self._sessions[next(iter(self._sessions))]

    def subscribe(self, request: ServerRequestContext, uri: str) -> None:
        """Add a subscription of a client of an older revision to the resource `uri`; called on the
        event loop.
        """
        self._loop = asyncio.get_running_loop()
        self._subscribers.setdefault(uri, {})[id(request.session)] = request.session

    def unsubscribe(self, request: ServerRequestContext, uri: str) -> None:
        """Remove a subscription."""
        self._subscribers.get(uri, {}).pop(id(request.session), None)

    def resource_updated(self, uri: str) -> None:
        """Notify the subscribers of a resource; callable from any thread."""
        subscribers = self._subscribers.setdefault(uri, {})
        self._tell(
            ResourceUpdated(uri=uri),
            subscribers,
            lambda session: session.send_resource_updated(uri),
        )

    def tools_changed(self) -> None:
        """Notify all clients; callable from any thread, does nothing before the first client."""
        self._tell(
            ToolsListChanged(), self._sessions, lambda session: session.send_tool_list_changed()
        )

    def _tell(
        self,
        event: ResourceUpdated | ToolsListChanged,
        sessions: dict[int, ServerSession],
        send: Callable[[ServerSession], Awaitable[None]],
    ) -> None:
        async def tell() -> None:
            await self.bus.publish(event)
            for key, session in list(sessions.items()):
                try:
                    await send(session)
                except (BrokenResourceError, ClosedResourceError, MCPError) as error:
                    log.debug("A client is gone: %r", error)
                    sessions.pop(key, None)

        def begin() -> None:
            task = asyncio.ensure_future(tell())
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(begin)
