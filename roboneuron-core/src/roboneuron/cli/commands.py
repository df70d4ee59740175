"""The table of commands; adding one is a module here and a line in it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import NamedTuple, Protocol


class Command(NamedTuple):
    """Where a command lives and what it does in one line."""

    module: str
    summary: str


class CommandModule(Protocol):
    """What a command's module holds."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the command's arguments to its parser."""
        ...

    def run(self, arguments: Namespace) -> int:
        """Do it and return the exit status; a RoboNeuronError is shown by `main` and ends with status 2."""
        ...


COMMANDS: dict[str, Command] = {
    "demo": Command("roboneuron.cli.demo", "an agent stand-in picks up a cube with the simulated robot"),
    "serve": Command("roboneuron.cli.serve", "serve MCP tools for a robot (an agent's client starts this)"),
    "doctor": Command("roboneuron.cli.doctor", "check whether this machine and a configuration are ready"),
    "estop": Command("roboneuron.cli.estop", "stop all motion now, with or without a server"),
    "tools": Command("roboneuron.cli.tools", "list the tools that agents get"),
    "call": Command("roboneuron.cli.call", "call a tool as an agent would, on a spawned or a running server"),
    "config": Command("roboneuron.cli.config", "show the default configuration, check one, list all keys"),
    "describe": Command("roboneuron.cli.describe", "show a ROS interface as agents see it, or list the installed ones"),
    "plugins": Command("roboneuron.cli.plugins", "list, show and check the installed plugins"),
    "new": Command("roboneuron.cli.new", "write a plugin package that passes its contract tests"),
}
"""Command by name, in the order of `roboneuron --help`."""
