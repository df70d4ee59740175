"""The command `roboneuron status`."""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from rn_standard.console.status import ServerStatus

LISTEN_S = 1.5
"""Listening time: modules report five times a second; the rest is for discovery."""


class StatusCommand:
    """Show the state of the modules: health, rates, latencies, ages, drops, and the emergency stop.

    With --url it asks a running HTTP server. Without it, it shows what modules report on
    /diagnostics of this shell's ROS domain. Exit status 0 when something runs and nothing is wrong,
    else 1.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron status`."""
        from rn_standard.console import connection

        connection.add_arguments(parser)
        parser.add_argument(
            "--watch",
            nargs="?",
            type=float,
            const=1.0,
            metavar="SECONDS",
            help="show it again and again, every second by default, until Ctrl-C",
        )
        parser.add_argument(
            "--json", action="store_true", help="one JSON object a line, for programs"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron status`."""
        from roboneuron import ConfigurationError

        if arguments.watch is not None and not 0.1 <= arguments.watch <= 3600:
            raise ConfigurationError(
                f"--watch {arguments.watch:g} is out of range: 0.1 to 3600 seconds."
            )
        try:
            return _show(arguments)
        except KeyboardInterrupt:
            if arguments.watch is None:
                raise
            return 0  # the regular end of a watch


def _show(arguments: Namespace) -> int:
    if arguments.url is not None:
        import anyio  # heavy

        return anyio.run(_ask, arguments)
    from roboneuron.command import environment, load_config

    configured = (
        load_config(arguments.config).supervisor.state_directory if arguments.config else None
    )
    return _listen(arguments, environment.state_directory(configured))


def exit_status(statuses: Sequence[ServerStatus]) -> int:
    """0 if something runs and nothing is wrong."""
    modules = [module for status in statuses for module in status.running]
    is_stopped = any(status.emergency_stop for status in statuses)
    return int(not modules or is_stopped or any(module.is_faulty for module in modules))


async def _ask(arguments: Namespace) -> int:
    """Query a running server."""
    import anyio

    from rn_standard.console import connection
    from rn_standard.console.session import ConsoleSession

    async with connection.connect(arguments) as client:
        session = ConsoleSession(client, arguments.url)
        with _Display(arguments) as display:
            while True:
                statuses = await session.statuses()
                display.show(statuses)
                if arguments.watch is None:
                    return exit_status(statuses)
                await anyio.sleep(arguments.watch)


def _listen(arguments: Namespace, directory: Path) -> int:
    """Listen to the modules of this ROS domain."""
    from rn_standard.console.diagnostics import DiagnosticsListener
    from rn_standard.console.interrupt import lasting_interrupt

    listener = DiagnosticsListener(directory)
    listener.open()
    try:
        time.sleep(LISTEN_S)
        with _Display(arguments) as display, lasting_interrupt() as interrupted:
            while not interrupted():
                statuses = listener.read_status()
                display.show(statuses, listener.servers_elsewhere())
                if arguments.watch is None:
                    return exit_status(statuses)
                time.sleep(arguments.watch)
            raise KeyboardInterrupt
    finally:
        listener.close()


class _Display:
    """Shows statuses once, or repeatedly in one place on a terminal."""

    def __init__(self, arguments: Namespace) -> None:
        self._as_json = arguments.json
        self._is_watching = arguments.watch is not None
        self._stack = ExitStack()
        self.show_view: Callable[[object], None] = print

    def __enter__(self) -> _Display:
        from rich.live import Live

        from rn_standard.console.table import make_console

        console = make_console()
        if self._is_watching and console.is_terminal and not self._as_json:
            live = self._stack.enter_context(Live(console=console, screen=True, auto_refresh=False))
            self.show_view = lambda view: live.update(view, refresh=True)  # type: ignore[arg-type]
        else:
            self.show_view = console.print
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def show(self, statuses: Sequence[ServerStatus], more: Sequence[str] = ()) -> None:
        """Show the statuses, and lines about other servers."""
        if self._as_json:
            print(json.dumps([status.model_dump(mode="json") for status in statuses]), flush=True)
            return
        from rich.console import Group
        from rich.text import Text

        from rn_standard.console.table import status_view

        lines = [Text(line, style="yellow") for line in more]
        hint = (
            [Text(f"{time.strftime('%H:%M:%S')}  Ctrl-C ends", style="dim")]
            if self._is_watching
            else []
        )
        self.show_view(Group(status_view(statuses), *lines, *hint))
