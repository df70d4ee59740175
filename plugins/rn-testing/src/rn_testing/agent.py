"""An MCP client of a server in its own process, for tests of what agents receive."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from mcp import Client, StdioServerParameters


class Agent:
    """Calls tools.

    Attributes:
        told: progress messages of all its calls.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self.told: list[str] = []

    async def call(self, tool: str, **arguments: object) -> tuple[bool, dict[str, Any], str]:
        """Call a tool; return whether it succeeded, its structured answer, and its text."""

        async def note(progress: float, total: float | None, message: str | None) -> None:
            self.told.append(message or "")

        answer = await self._client.call_tool(tool, arguments, progress_callback=note)
        text = getattr(answer.content[0], "text", "") if answer.content else ""
        return not answer.is_error, dict(answer.structured_content or {}), text

    async def do(self, tool: str, **arguments: object) -> dict[str, Any]:
        """Return the answer of a call that must succeed. Raises AssertionError."""
        succeeded, answer, text = await self.call(tool, **arguments)
        assert succeeded, (tool, arguments, text)
        return answer

    async def fail(self, tool: str, **arguments: object) -> str:
        """Return the text of a call that must fail. Raises AssertionError."""
        succeeded, answer, text = await self.call(tool, **arguments)
        assert not succeeded, (tool, arguments, answer)
        return text


@asynccontextmanager
async def client_of(
    config: Path, environment: Mapping[str, str], *options: str
) -> AsyncIterator[Client]:
    """Start `roboneuron serve` with a configuration, and connect to it.

    Args:
        config: configuration file.
        environment: environment of the process.
        options: further command-line arguments.
    """
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), *options]
    server = StdioServerParameters(command=sys.executable, args=words, env=dict(environment))
    async with Client(server) as client:
        yield client
