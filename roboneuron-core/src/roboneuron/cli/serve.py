"""Serve MCP tools for a robot: the agent's client starts this and speaks JSON-RPC on stdin and stdout."""

from __future__ import annotations

import logging
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path


def configure(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron serve`."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="a roboneuron.toml; the embedded default without it"
    )
    parser.add_argument("--transport", choices=["stdio"], default="stdio", help="how the client connects")
    parser.add_argument(
        "--log-level", choices=["debug", "info", "warning", "error"], default="info", help="of the log on stderr"
    )


def run(arguments: Namespace) -> int:
    """Run `roboneuron serve`."""
    from roboneuron.server.stdio import divert_standard_streams

    wire = divert_standard_streams()
    logging.basicConfig(
        level=arguments.log_level.upper(), stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    from roboneuron.config import load_config

    config = load_config(arguments.config)
    from roboneuron.server.app import serve_stdio  # heavy

    serve_stdio(config, wire)
    return 0
