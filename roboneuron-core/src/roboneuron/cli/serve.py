"""Serve MCP tools for a robot: on stdin and stdout for the agent that starts this, or over HTTP for several."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.log_files import begin_logging

if TYPE_CHECKING:
    from roboneuron.config import Config


def configure(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron serve`."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="a roboneuron.toml; the embedded default without it"
    )
    parser.add_argument(
        "--transport", choices=["stdio", "http"], help="how clients connect; `server.transport` without it"
    )
    parser.add_argument("--host", help="address that http listens on; `server.host` without it")
    parser.add_argument("--port", type=int, help="port of http, 0 for any free one; `server.port` without it")
    parser.add_argument(
        "--log-level", choices=["debug", "info", "warning", "error"], default="info", help="of the log on stderr"
    )


def run(arguments: Namespace) -> int:
    """Run `roboneuron serve`."""
    from roboneuron.server.stdio import divert_standard_streams

    wire = divert_standard_streams()
    begin_logging(arguments.log_level.upper())
    from roboneuron.config import load_config

    config = with_server(load_config(arguments.config), arguments)
    if config.server.transport == "http":
        from roboneuron.server.http import serve_http  # heavy

        serve_http(config)
        return 0
    from roboneuron.server.app import serve_stdio  # heavy

    serve_stdio(config, wire)
    return 0


def with_server(config: Config, arguments: Namespace) -> Config:
    """The configuration with what the command line says about the server.

    Raises:
        ConfigurationError: the port is none, or an address is given for stdio.
    """
    from roboneuron.errors import ConfigurationError

    names = ("transport", "host", "port")
    chosen = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    if not 0 <= chosen.get("port", 0) <= 65535:
        raise ConfigurationError(f"--port {chosen['port']} is not a port: 0 to 65535.")
    section = config.server.model_copy(update=chosen)
    if section.transport == "stdio" and ("host" in chosen or "port" in chosen):
        raise ConfigurationError("--host and --port are for http.", hint="Add --transport http.")
    return config.model_copy(update={"server": section})
