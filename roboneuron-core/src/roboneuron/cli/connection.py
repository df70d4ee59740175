"""A client of a server: a spawned one, or a running one over HTTP with a token from the environment."""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.errors import ConfigurationError

if TYPE_CHECKING:
    from mcp import Client

TOKEN_VARIABLE = "ROBONEURON_TOKEN"
"""Environment variable with the bearer token for `--url`, when no other is named."""


def add_arguments(parser: ArgumentParser) -> None:
    """Add --config, --url and --token-variable."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--config", type=Path, metavar="FILE", help="a roboneuron.toml; the embedded default without it")
    where.add_argument("--url", help="a running server instead, such as http://127.0.0.1:8765/mcp")
    parser.add_argument(
        "--token-variable",
        metavar="NAME",
        help=f"environment variable with the bearer token for --url; {TOKEN_VARIABLE} when that is set",
    )


@asynccontextmanager
async def connect(arguments: Namespace) -> AsyncIterator[Client]:
    """A connected client.

    Raises:
        ConfigurationError: there is no such server, it refuses the token, or the token's variable is not set.
    """
    if arguments.url is None:
        options = ["--log-level", "error"]
        if arguments.config is not None:
            options += ["--config", str(arguments.config)]
        async with spawned_server(options) as client:
            yield client
        return
    import httpx2  # heavy; the client library of mcp 2
    from mcp import Client  # heavy
    from mcp.client.streamable_http import streamable_http_client  # heavy
    from mcp.shared.exceptions import MCPError

    token = _token(arguments.token_variable)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    timeout = httpx2.Timeout(30.0, read=300.0)
    try:
        async with httpx2.AsyncClient(headers=headers, timeout=timeout) as http:
            await _knock(http, arguments.url)
            async with Client(streamable_http_client(arguments.url, http_client=http)) as client:
                yield client
    except (httpx2.HTTPError, httpx2.InvalidURL, MCPError, ExceptionGroup) as error:
        cause = next(_leaves(error))
        if not isinstance(cause, httpx2.HTTPError | httpx2.InvalidURL | MCPError):
            raise
        raise ConfigurationError(f"The server at {arguments.url} does not answer as one: {cause}.") from cause


@asynccontextmanager
async def spawned_server(options: Sequence[str], log: Path | None = None) -> AsyncIterator[Client]:
    """A client of a server that this process starts and ends.

    Args:
        options: of `roboneuron serve`.
        log: file for what the server writes to its standard error; None for this process's own.

    Raises:
        ConfigurationError: the server ended before it answered; its last words are in the message.
    """
    from mcp import Client, StdioServerParameters  # heavy
    from mcp.client.stdio import stdio_client  # heavy
    from mcp.shared.exceptions import MCPError

    words = ["-P", "-m", "roboneuron.cli.main", "serve", "--transport", "stdio", *options]
    server = StdioServerParameters(command=sys.executable, args=words, env=dict(os.environ))
    answered = False
    with nullcontext(sys.stderr) if log is None else log.open("w", encoding="utf-8") as errors:
        try:
            async with Client(stdio_client(server, errlog=errors)) as client:
                answered = True
                yield client
        except (MCPError, ExceptionGroup) as error:
            if answered or not all(isinstance(leaf, MCPError | OSError) for leaf in _leaves(error)):
                raise
            raise ConfigurationError("The server ended before it answered.", hint=_last_words(log)) from error


def _last_words(log: Path | None) -> str:
    if log is None:
        return "What it said stands above."
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return f"Its last words: {lines[-1] if lines else 'none'}\nAll of them: {log}"


async def _knock(http: object, url: str) -> None:
    """Learn what a client library would wrap: nobody listens, or the token is refused."""
    import httpx2  # heavy

    assert isinstance(http, httpx2.AsyncClient)
    try:
        answer = await http.delete(url)  # of no session: nothing happens
    except httpx2.ConnectError as error:
        raise ConfigurationError(f"Nobody answers at {url}: {error}.", hint="Is the server running?") from error
    if answer.status_code == 401:
        raise ConfigurationError(
            f"The server at {url} refuses the token.",
            hint=f"Name the variable that holds it with --token-variable, or set {TOKEN_VARIABLE}.",
        )


def _token(variable: str | None) -> str | None:
    token = os.environ.get(variable or TOKEN_VARIABLE)
    if variable is not None and not token:
        raise ConfigurationError(f"The environment variable {variable} is not set.")
    return token or None


def _leaves(error: Exception) -> Iterator[Exception]:
    if isinstance(error, ExceptionGroup):
        for part in error.exceptions:
            yield from _leaves(part)
    else:
        yield error
