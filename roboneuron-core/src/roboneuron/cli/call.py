"""Call one tool of a server, as an agent would: a spawned one, or a running one over HTTP."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboneuron.cli import connection

if TYPE_CHECKING:
    from mcp import types


def configure(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron call`."""
    parser.add_argument("tool", metavar="TOOL", help="as in `roboneuron tools`")
    parser.add_argument("arguments", metavar="JSON", nargs="?", default="{}", help="such as '{\"timeout_s\": 2}'")
    parser.add_argument(
        "--then", nargs=2, action="append", default=[], metavar=("TOOL", "JSON"), help="call another one after it"
    )
    connection.add_arguments(parser)
    parser.add_argument("--images", type=Path, metavar="FOLDER", help="save the images of the answer here")


def run(arguments: Namespace) -> int:
    """Call, print the structured answers as JSON lines; status 1 when one is an error, and no further calls."""
    calls = [(arguments.tool, arguments.arguments), *arguments.then]
    parsed = [(tool, _parse(text)) for tool, text in calls]
    import anyio  # heavy

    return anyio.run(_call_all, arguments, parsed)


def _parse(text: str) -> dict[str, Any]:
    from roboneuron.errors import ConfigurationError

    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        raise ConfigurationError(f"The arguments {text[:80]!r} are not JSON: {error}.") from error
    if not isinstance(value, dict):
        raise ConfigurationError(f"The arguments {text[:80]!r} are not a JSON object.", hint="Write '{}' for none.")
    return value


async def _call_all(arguments: Namespace, calls: list[tuple[str, dict[str, Any]]]) -> int:
    async with connection.connect(arguments) as client:
        for tool, values in calls:
            answer = await client.call_tool(tool, values, progress_callback=_show_progress)
            if answer.is_error:
                print(f"roboneuron: {_text(answer)}", file=sys.stderr)
                return 1
            print(json.dumps(answer.structured_content, indent=2))
            if arguments.images is not None:
                _save_images(answer, arguments.images, tool)
    return 0


async def _show_progress(progress: float, total: float | None, message: str | None) -> None:
    print(f"... {message or progress}", file=sys.stderr)


def _text(answer: types.CallToolResult) -> str:
    from mcp import types

    return " ".join(block.text for block in answer.content if isinstance(block, types.TextContent))


def _save_images(answer: types.CallToolResult, folder: Path, tool: str) -> None:
    from base64 import b64decode

    from mcp import types

    folder.mkdir(parents=True, exist_ok=True)
    pictures = [block for block in answer.content if isinstance(block, types.ImageContent)]
    for index, picture in enumerate(pictures):
        path = folder / f"{tool}_{index}.{picture.mime_type.partition('/')[2]}"
        path.write_bytes(b64decode(picture.data))
        print(f"saved {path}", file=sys.stderr)
