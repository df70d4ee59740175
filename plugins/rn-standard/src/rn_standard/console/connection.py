"""Client of a server: a spawned one, or a running one over HTTP with a token from the
environment.
"""

from __future__ import annotations

import logging
import os
from argparse import ArgumentParser, Namespace
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rn_standard.console.client import hush_unlisted_tools, leaves_of, spawned_server
from roboneuron import ConfigurationError
from roboneuron.command import environment, terminal

if TYPE_CHECKING:
    from mcp import Client


def add_arguments(parser: ArgumentParser) -> None:
    """Add --config, --url and --token-variable."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a roboneuron.toml; the embedded default without it",
    )
    where.add_argument("--url", help="a running server instead, such as http://127.0.0.1:8765/mcp")
    parser.add_argument(
        "--token-variable",
        metavar="NAME",
        help="environment variable with the bearer token for --url; "
        f"{environment.CLIENT_TOKEN} when that is set",
    )


@asynccontextmanager
async def connect(arguments: Namespace) -> AsyncIterator[Client]:
    """Create a connected client.

    Raises:
        ConfigurationError: the server is not reachable, it refuses the token, or the token's
            variable is not set.
    """
    if arguments.url is None:
        level = terminal.log_level(arguments)
        # its warnings are also part of the answers
        options = ["--log-level", "error" if level == "warning" else level]
        if arguments.config is not None:
            options += ["--config", str(arguments.config)]
        async with spawned_server(options) as client:
            yield client
        return
    import httpx2  # heavy; the client library of mcp 2
    from mcp import Client  # heavy
    from mcp.client.streamable_http import streamable_http_client  # heavy
    from mcp.shared.exceptions import MCPError

    logging.getLogger("mcp").addHandler(logging.NullHandler())  # its warnings become our error
    hush_unlisted_tools()
    token = _token(arguments.token_variable)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    timeout = httpx2.Timeout(30.0, read=300.0)
    try:
        async with httpx2.AsyncClient(headers=headers, timeout=timeout) as http:
            await _knock(http, arguments.url)
            async with Client(streamable_http_client(arguments.url, http_client=http)) as client:
                yield client
    except (httpx2.HTTPError, httpx2.InvalidURL, MCPError, OverflowError, ExceptionGroup) as error:
        cause = next(leaves_of(error))
        if not isinstance(cause, httpx2.HTTPError | httpx2.InvalidURL | MCPError | OverflowError):
            raise
        raise ConfigurationError(
            f"The server at {arguments.url} does not answer as one: {str(cause).rstrip('.')}."
        ) from cause


async def _knock(http: object, url: str) -> None:
    """Detect errors that a client library would wrap: no server, or a refused token."""
    import httpx2  # heavy

    assert isinstance(http, httpx2.AsyncClient)
    try:
        answer = await http.delete(url)  # without a session, so that nothing happens
    except httpx2.ConnectError as error:
        raise ConfigurationError(
            f"Nobody answers at {url}: {error}.", hint="Is the server running?"
        ) from error
    if answer.status_code == 401:
        raise ConfigurationError(
            f"The server at {url} refuses the token.",
            hint="Name the variable that holds it with --token-variable, or set "
            f"{environment.CLIENT_TOKEN}.",
        )


def _token(variable: str | None) -> str | None:
    token = os.environ.get(variable or environment.CLIENT_TOKEN)
    if variable is not None and not token:
        raise ConfigurationError(f"The environment variable {variable} is not set.")
    return token or None
