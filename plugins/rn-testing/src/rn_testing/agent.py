"""An MCP client of a server in its own process, for tests of what agents receive."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, TextIO

from anyio.from_thread import BlockingPortal, start_blocking_portal
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client


class Agent:
    """Calls tools.

    Attributes:
        told: progress messages of all its calls.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self.told: list[str] = []

    async def call(self, tool: str, /, **arguments: object) -> tuple[bool, dict[str, Any], str]:
        """Call a tool; return whether it succeeded, its structured answer, and its text."""

        async def note(progress: float, total: float | None, message: str | None) -> None:
            self.told.append(message or "")

        answer = await self._client.call_tool(tool, arguments, progress_callback=note)
        text = getattr(answer.content[0], "text", "") if answer.content else ""
        return not answer.is_error, dict(answer.structured_content or {}), text

    async def do(self, tool: str, /, **arguments: object) -> dict[str, Any]:
        """Return the answer of a call that must succeed. Raises AssertionError."""
        succeeded, answer, text = await self.call(tool, **arguments)
        assert succeeded, (tool, arguments, text)
        return answer

    async def fail(self, tool: str, /, **arguments: object) -> str:
        """Return the text of a call that must fail. Raises AssertionError."""
        succeeded, answer, text = await self.call(tool, **arguments)
        assert not succeeded, (tool, arguments, answer)
        return text


class BlockingAgent:
    """Calls tools from a thread without an event loop.

    Args:
        client, portal: see `blocking_client`.
        always: arguments of each call, such as the robot.
    """

    def __init__(self, client: Client, portal: BlockingPortal, **always: object) -> None:
        self._client, self._portal, self._always = client, portal, always

    def ask(self, tool: str, /, **arguments: object) -> Any:
        """Call a tool; return its answer, also an error."""
        return self._portal.call(self._client.call_tool, tool, {**self._always, **arguments})

    def do(self, tool: str, /, **arguments: object) -> dict[str, Any]:
        """Return the structured answer of a call. Raises RuntimeError if it fails."""
        answer = self.ask(tool, **arguments)
        if answer.is_error:
            raise RuntimeError(f"{tool}: {answer.content[0].text}")
        return dict(answer.structured_content or {})

    def modules(self) -> dict[str, dict[str, Any]]:
        """The modules of get_status, by kind."""
        status = self.do("get_status", details=True)
        return {module["module"]: module for module in status["modules"]}


@asynccontextmanager
async def client_of(
    config: Path,
    environment: Mapping[str, str],
    *options: str,
    timeout_s: float | None = None,
    errors: TextIO | None = None,
) -> AsyncIterator[Client]:
    """Start `roboneuron serve` with a configuration, and connect to it.

    Args:
        config: configuration file.
        environment: environment of the process.
        options: further command-line arguments.
        timeout_s: how long a call may take; the client's own limit if None.
        errors: file for its standard error; this process's own if None.
    """
    words = ["-P", "-m", "roboneuron.cli.main", "serve", "--config", str(config), *options]
    server = StdioServerParameters(command=sys.executable, args=words, env=dict(environment))
    transport = stdio_client(server, errlog=errors or sys.stderr)
    async with Client(transport, read_timeout_seconds=timeout_s) as client:
        yield client


@contextmanager
def blocking_client(
    config: Path,
    environment: Mapping[str, str],
    *options: str,
    timeout_s: float = 180.0,
    errors: TextIO | None = None,
) -> Iterator[tuple[Client, BlockingPortal]]:
    """As `client_of`, with the portal by which a thread without an event loop calls it."""
    served = client_of(config, environment, *options, timeout_s=timeout_s, errors=errors)
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(served) as client,
    ):
        yield client, portal
