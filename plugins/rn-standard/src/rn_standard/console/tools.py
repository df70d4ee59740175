"""The command `roboneuron tools`."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from rn_standard.console import connection

if TYPE_CHECKING:
    from mcp.types import Tool


class Tools:
    """List the tools that agents get with the plugins installed here."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron tools`."""
        parser.add_argument(
            "--json", action="store_true", help="the answer of tools/list, schemas included"
        )
        connection.add_arguments(parser)

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron tools`."""
        listing = _listing(arguments)
        if arguments.json:
            print(
                json.dumps(
                    [
                        tool.model_dump(mode="json", by_alias=True, exclude_none=True)
                        for tool in listing
                    ],
                    indent=2,
                )
            )
            return 0
        width = max(len(tool.name) for tool in listing)
        for tool in listing:
            print(f"{tool.name:<{width}}  {tool.title or _first_sentence(tool)}")
        return 0


def _first_sentence(tool: Tool) -> str:
    """First sentence of the description; a title that repeats the name is not listed."""
    return (tool.description or "").partition(". ")[0].rstrip(".")


def _listing(arguments: Namespace) -> list[Tool]:
    """Tools of a running server, which may withhold tools from a role; or of a configuration."""
    if arguments.url is not None:
        import anyio  # heavy

        return anyio.run(_ask, arguments)
    from roboneuron.command import (
        load_config,
        make_served,  # heavy
    )

    served = make_served(load_config(arguments.config))
    try:
        return served.tools.listing()
    finally:
        served.close()


async def _ask(arguments: Namespace) -> list[Tool]:
    async with connection.connect(arguments) as client:
        return (await client.list_tools()).tools
