"""The command `roboneuron call`."""

from __future__ import annotations

import json
import signal
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from rn_standard.console import connection

if TYPE_CHECKING:
    from mcp import Client, types


class CallCommand:
    """Call tools of a server, as an agent would: of a running one over HTTP, or of one started for
    these calls.

    Without --url a server is started. It ends with the command, and so does everything that the
    calls have started.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron call`."""
        parser.add_argument("tool", metavar="TOOL", help="as in `roboneuron tools`")
        parser.add_argument(
            "arguments",
            metavar="JSON",
            nargs="?",
            default="{}",
            help="such as '{\"timeout_s\": 2}'",
        )
        parser.add_argument(
            "--then",
            nargs="+",
            action="append",
            default=[],
            metavar=("TOOL", "JSON"),
            help="call another one after it",
        )
        connection.add_arguments(parser)
        parser.add_argument(
            "--keep",
            action="store_true",
            help="after the calls keep the server, and what they started, until Ctrl-C",
        )
        parser.add_argument(
            "--images", type=Path, metavar="FOLDER", help="save the images of the answer here"
        )

    def run(self, arguments: Namespace) -> int:
        """Call the tools, print the structured answers as JSON lines; after an error, stop with
        status 1.
        """
        from roboneuron import ConfigurationError

        if too_long := next((words for words in arguments.then if len(words) > 2), None):
            raise ConfigurationError(
                f"--then takes a tool and its arguments, got {' '.join(too_long)!r}.",
                hint="Quote the JSON, and write --then once for each tool.",
            )
        if arguments.keep and arguments.url is not None:
            raise ConfigurationError(
                "--keep is for a server that `call` starts; the one at --url goes on by itself."
            )
        calls = [(arguments.tool, arguments.arguments), *arguments.then]
        parsed = [(call[0], _parse(call[1]) if len(call) > 1 else {}) for call in calls]
        import anyio  # heavy

        return anyio.run(_call_all, arguments, parsed)


def _parse(text: str) -> dict[str, object]:
    from roboneuron import ConfigurationError, ForeignDataError, foreign

    try:
        value = foreign.decode_json(text, f"The text {text[:80]!r}")
    except ForeignDataError as error:
        raise ConfigurationError(f"{error}.") from error
    if not isinstance(value, dict):
        raise ConfigurationError(
            f"The arguments {text[:80]!r} are not a JSON object.", hint="Write '{}' for none."
        )
    return value


async def _call_all(arguments: Namespace, calls: list[tuple[str, dict[str, object]]]) -> int:
    async with connection.connect(arguments) as client:
        status = 0
        for tool, values in calls:
            answer = await client.call_tool(
                tool, values, progress_callback=None if arguments.quiet else _show_progress
            )
            if answer.is_error:
                print(f"roboneuron: {_shown(_text(answer))}", file=sys.stderr)
                status = 1
                break
            print(json.dumps(answer.structured_content, indent=2), flush=True)
            if arguments.images is not None:
                _save_images(answer, arguments.images, tool)
        if arguments.url is None:
            await _end(client, stays=arguments.keep and status == 0, quiet=bool(arguments.quiet))
    return status


async def _end(client: Client, *, stays: bool, quiet: bool) -> None:
    """Print what ends with the server that this command has started; if it `stays`, wait for Ctrl-C
    first.
    """
    found = (await client.call_tool("get_status", {})).structured_content or {}
    running = [
        module["module"] for module in found.get("modules", ()) if module.get("pid") is not None
    ]
    what = ", ".join(["the server of this command", *running])
    if stays:
        import anyio

        print(
            f"roboneuron: running until Ctrl-C: {what} (pid {found.get('pid')}).", file=sys.stderr
        )
        with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
            async for _ in signals:
                break
    if not quiet and (running or stays):
        advice = "" if stays else " --keep keeps it running until Ctrl-C."
        print(f"roboneuron: ending {what}.{advice}", file=sys.stderr)


async def _show_progress(progress: float, total: float | None, message: str | None) -> None:
    print(f"... {_shown(message) if message else progress}", file=sys.stderr)


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


def _shown(text: str) -> str:
    """A server's words for the terminal."""
    from roboneuron import foreign

    return foreign.printable(text, 2000)
