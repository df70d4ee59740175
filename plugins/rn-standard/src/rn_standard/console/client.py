"""An MCP client of a server that this process starts."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import ConfigurationError, NotReadyError

if TYPE_CHECKING:
    from mcp import Client

TRUTH_SWITCH = "ROBONEURON_SIMULATOR_TRUTH"
"""Environment variable of a server that makes the simulator's ground truth available."""


@asynccontextmanager
async def spawned_server(options: Sequence[str], log: Path | None = None) -> AsyncIterator[Client]:
    """Create a client of a server that this process starts and ends; the simulator's ground truth
    is available to it.

    Args:
        options: options of `roboneuron serve`.
        log: file for the server's standard error; None for this process's own.

    Raises:
        ConfigurationError: the server ended before it answered; the message contains its last
            output.
        NotReadyError: it ended later, or violated the protocol.
    """
    from mcp import Client, StdioServerParameters  # heavy
    from mcp.client.stdio import stdio_client  # heavy
    from mcp.shared.exceptions import MCPError

    hush_unlisted_tools()
    words = ["-P", "-m", "roboneuron.cli.main", "serve", "--transport", "stdio", *options]
    environment = {TRUTH_SWITCH: "on", **os.environ}
    server = StdioServerParameters(command=sys.executable, args=words, env=environment)
    answered = False
    with nullcontext(sys.stderr) if log is None else log.open("w", encoding="utf-8") as errors:
        try:
            async with Client(stdio_client(server, errlog=errors)) as client:
                answered = True
                yield client
        except (MCPError, ExceptionGroup) as error:
            leaves = list(leaves_of(error))
            if not all(isinstance(leaf, MCPError | OSError) for leaf in leaves):
                raise
            if answered:
                raise NotReadyError(
                    f"The server broke off: {str(leaves[0]).rstrip('.')}.", hint=_last_words(log)
                ) from error
            raise ConfigurationError(
                "The server ended before it answered.", hint=_last_words(log)
            ) from error


def hush_unlisted_tools() -> None:
    """Keep the SDK's client from warning at each call of a tool that only find_tools lists."""
    logging.getLogger("client").setLevel(logging.ERROR)


def _last_words(log: Path | None) -> str:
    if log is None:
        return "What it said stands above."
    lines = [
        line.strip()
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()
        if line.strip()
    ]
    return f"Its last words: {lines[-1] if lines else 'none'} (all of them: {log})"


def leaves_of(error: Exception) -> Iterator[Exception]:
    """The exceptions in a group, at any depth; `error` itself if it is not a group."""
    if isinstance(error, ExceptionGroup):
        for part in error.exceptions:
            yield from leaves_of(part)
    else:
        yield error
