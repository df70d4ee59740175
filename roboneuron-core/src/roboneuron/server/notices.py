"""Telling clients of both protocol eras that the tools changed, from any thread."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

from anyio import BrokenResourceError, ClosedResourceError
from mcp.server.context import ServerRequestContext
from mcp.server.subscriptions import InMemorySubscriptionBus, ToolsListChanged
from mcp.shared.exceptions import MCPError

log = logging.getLogger(__name__)
_MOST_SESSIONS = 64
_FIRST_WITHOUT_HANDSHAKE = "2026"
"""Revisions from here on deliver changes to those that listen; older ones to every session."""


class ToolNotices:
    """Remembers who listed the tools.

    Attributes:
        bus: events for clients of the 2026 revisions; give it to a `ListenHandler`.
    """

    def __init__(self) -> None:
        self.bus = InMemorySubscriptionBus()
        self._sessions: dict[int, Any] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    def remember(self, request: ServerRequestContext[Any, Any]) -> None:
        """A client listed the tools; called on the event loop."""
        self._loop = asyncio.get_running_loop()
        if request.protocol_version < _FIRST_WITHOUT_HANDSHAKE:
            self._sessions[id(request.session)] = request.session
            while len(self._sessions) > _MOST_SESSIONS:
                del self._sessions[next(iter(self._sessions))]

    def tools_changed(self) -> None:
        """Tell everybody; callable from any thread, does nothing before the first client."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._begin)

    def _begin(self) -> None:
        task = asyncio.ensure_future(self._tell())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _tell(self) -> None:
        await self.bus.publish(ToolsListChanged())
        for key, session in list(self._sessions.items()):
            try:
                await session.send_tool_list_changed()
            except (BrokenResourceError, ClosedResourceError, MCPError) as error:
                log.debug("A client is gone: %r", error)
                self._sessions.pop(key, None)
