"""Typed results for an MCP client's calls: an answer, or an exception with the server's message."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mcp import Client
from mcp.types import TextContent

from rn_standard.console.status import ServerStatus
from roboneuron import NotReadyError

_CALL_TIMEOUT_S = 900.0
"""Timeout of a call: a model may load for minutes; the server has its own timeouts for everything
it starts.
"""


class ConsoleSession:
    """Client session that calls tools of one server.

    Args:
        source: description of the server.
    """

    def __init__(self, client: Client, source: str) -> None:
        self._client = client
        self._source = source

    async def call(
        self,
        tool: str,
        arguments: Mapping[str, object] | None = None,
        on_progress: Callable[[str], None] | None = None,
        timeout_s: float = _CALL_TIMEOUT_S,
    ) -> dict[str, Any]:
        """Call a tool, and wait for its answer for `timeout_s`.

        Raises:
            NotReadyError: the tool answered with an error; contains its text.
        """

        async def progress(progress: float, total: float | None, message: str | None) -> None:
            if on_progress is not None and message:
                on_progress(message)

        answer = await self._client.call_tool(
            tool,
            dict(arguments or {}),
            read_timeout_seconds=timeout_s,
            progress_callback=progress,
        )
        if answer.is_error:
            raise NotReadyError(
                " ".join(part.text for part in answer.content if isinstance(part, TextContent))
            )
        return dict(answer.structured_content or {})

    async def robots(self, tool: str) -> list[dict[str, str]]:
        """Arguments that select each robot for a tool: `robot` if the server has several.

        Raises:
            NotReadyError: the server has no such tool.
        """
        tools = {found.name: found for found in (await self._client.list_tools()).tools}
        if tool not in tools:
            raise NotReadyError(
                f"The server has no tool {tool}.",
                hint="Install what brings it where the server runs.",
            )
        if "robot" not in tools[tool].input_schema.get("required", ()):
            return [{}]
        return [{"robot": name} for name in tools[tool].input_schema["properties"]["robot"]["enum"]]

    async def status(self) -> ServerStatus:
        """Return the answer of `get_status`."""
        answer = await self.call("get_status", {"details": True})
        return ServerStatus.from_answer(answer, self._source)

    async def statuses(self) -> list[ServerStatus]:
        """Return the answers of `get_status`, one for each robot."""
        return [
            ServerStatus.from_answer(
                await self.call("get_status", {**robot, "details": True}), self._source
            )
            for robot in await self.robots("get_status")
        ]
