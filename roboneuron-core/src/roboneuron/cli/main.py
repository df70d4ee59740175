"""The `roboneuron` command: runs one command of core or of a plugin, and shows deliberate errors in
one sentence.

A command named `plugins-list` is used as `roboneuron plugins list`: its group, then its action.
"""

from __future__ import annotations

import os
import sys
from argparse import SUPPRESS, ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import NamedTuple, Protocol, cast

from roboneuron import __version__
from roboneuron.cli.terminal import (
    EXIT_USAGE,
    accept_any_text,
    add_verbosity,
    apply_verbosity,
    show_error,
    with_verbosity_behind,
)
from roboneuron.errors import MissingDependencyError, PluginError, nearest
from roboneuron.plugins.availability import install_command, known_names, package_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_target
from roboneuron.plugins.registry import Registry, Status
from roboneuron.plugins.specs import CommandSpec
from roboneuron.ros.installation import keep_apart


class Command(NamedTuple):
    """Module of a core command and its one-line summary."""

    module: str
    summary: str


class CommandModule(Protocol):
    """Interface of a core command's module, and of a plugin's command object."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the command's arguments to its parser."""

    def run(self, arguments: Namespace) -> int:
        """Run the command and return the exit status; `main` shows a RoboNeuronError and ends with
        status 2.
        """


COMMANDS: dict[str, Command] = {
    "serve": Command(
        "roboneuron.cli.serve", "serve MCP tools for a robot (an agent's client starts this)"
    ),
    "estop": Command("roboneuron.estop.command", "stop all motion now, with or without a server"),
}
"""Command by name, in the order of `roboneuron --help`."""
GROUPS = ("config", "plugins")
"""Words before the actions of several commands."""
_MOST_PORT = 65535


def spoken(name: str) -> str:
    """A command's name on the command line."""
    return name.replace("-", " ", 1) if name.partition("-")[0] in GROUPS else name


def named_command(words: Sequence[str]) -> tuple[str, list[str]]:
    """Split a command line into the name of its command and the remaining words.

    Options may stand between a group and its action: `plugins --config FILE list`.
    """
    name, *own = words
    actions = [
        i
        for i, word in enumerate(own)
        if not word.startswith("-") and own[i - 1 : i] != ["--config"]
    ]
    if name not in GROUPS or not actions:
        return name, own
    return f"{name}-{own.pop(actions[0])}", own


@dataclass(frozen=True, kw_only=True, slots=True)
class ListedCommand:
    """A command that can be run here.

    Attributes:
        name: as its plugin offers it.
        summary: one line.
        registry: the installed plugins; None for a command of the core.
    """

    name: str
    summary: str
    registry: Registry | None

    @property
    def words(self) -> str:
        """Its name on the command line."""
        return spoken(self.name)

    def load(self) -> CommandModule:
        """Import it.

        Raises:
            ConfigurationError: no installed plugin offers it, or the plugin is unusable, with the
                reason.
            PluginError, MissingDependencyError: it cannot be loaded.
        """
        if self.registry is None:
            return cast(CommandModule, import_module(COMMANDS[self.name].module))
        target = load_target(self.registry.get(CommandSpec, self.name))
        if not callable(target):
            raise PluginError(
                f"The target of command {self.name!r} is {target!r}, expected a class."
            )
        command = target()
        if not (
            callable(getattr(command, "configure", None))
            and callable(getattr(command, "run", None))
        ):
            raise PluginError(
                f"The command {self.name!r} is {command!r}, expected the methods configure and run."
            )
        return cast(CommandModule, command)


def all_commands(registry: Registry) -> tuple[ListedCommand, ...]:
    """The core's commands and the usable ones of plugins; one with the name of a core command is
    left out.
    """
    own = [
        ListedCommand(name=name, summary=command.summary, registry=None)
        for name, command in COMMANDS.items()
    ]
    installed = [
        ListedCommand(name=offer.spec.name, summary=offer.spec.summary, registry=registry)
        for offer in registry.offers("command")
        if offer.status is Status.READY and offer.spec.name not in COMMANDS
    ]
    return (*own, *installed)


def configure(
    command: CommandModule, parser: ArgumentParser, words: Sequence[str] | None = None
) -> None:
    """Add the arguments of a command, those that installed plugins give it, and those that every
    command has.

    Args:
        command: of `ListedCommand.load`.
        parser: of the command.
        words: what is to be parsed; plugins are asked only if it may need them. None for all.
    """
    command.configure(parser)
    add_verbosity(parser)
    add_installed = getattr(command, "add_installed_flags", None)
    # Discovery imports every plugin, so it is done only for more than core's own flags.
    if add_installed is not None and (
        words is None or {"-h", "--help"} & set(words) or parser.parse_known_args(words)[1]
    ):
        add_installed(parser)


def run_command(command: CommandModule, prog: str, words: Sequence[str]) -> int:
    """Parse the words after `prog`, run the command and return its exit status.

    Args:
        command: configures the parser, and runs.
        prog: name of the command in its help.
        words: the remaining words of the command line.
    """
    parser = ArgumentParser(prog=prog, description=command.__doc__)
    configure(command, parser, words)
    arguments = parser.parse_args(words)
    port = getattr(arguments, "port", 0)  # of several commands
    if isinstance(port, int) and not 0 <= port <= _MOST_PORT:
        shown = str(port)[:20]
        parser.error(f"argument --port: {shown} is no port: name one from 0 to {_MOST_PORT}")
    apply_verbosity(arguments)
    return command.run(arguments)


def build_parser(registry: Registry, group: str = "") -> ArgumentParser:
    """Create the parser of `roboneuron`, or of a group of its commands; commands are listed, not
    imported.

    Args:
        registry: the installed plugins.
        group: one of `GROUPS`, or empty for all commands.

    Raises:
        MissingDependencyError: no installed package has an action of the group.
    """
    listed = {
        command.words: command.summary
        for command in all_commands(registry)
        if command.words.startswith(f"{group} ".lstrip())
    }
    if not listed:
        bringing = {p for n, p in known_names("command").items() if spoken(n).startswith(group)}
        raise MissingDependencyError(
            f"No installed package has an action of `roboneuron {group}`.",
            hint=f"Run: {install_command(*sorted(bringing))}.",
        )
    width = max(len(name) for name in listed)
    table = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in listed.items())
    parser = ArgumentParser(
        prog="roboneuron",
        usage=f"roboneuron {group or 'COMMAND'} {'ACTION ' if group else ''}[options]",
        description="Typed MCP tools and supervised closed loops between LLM agents, ROS 2 robots "
        "and VLA models.",
        epilog=f"commands:\n{table}\n\n`roboneuron COMMAND --help` explains one of them.",
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"roboneuron {__version__}")
    parser.add_argument("command", metavar="COMMAND", nargs="?", help=SUPPRESS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status.

    Args:
        argv: the words after `roboneuron`; those of this process by default.
    """
    accept_any_text()
    words = with_verbosity_behind(sys.argv[1:] if argv is None else argv)
    name, own = named_command(words) if words else ("", [])
    if not name or name.startswith("-") or name in GROUPS:
        is_group = name in GROUPS
        try:
            parser = build_parser(discover(), name if is_group else "")
        except MissingDependencyError as error:
            return show_error(error)
        parser.parse_args(own if is_group else words)  # --help and --version end here
        parser.print_help(sys.stderr)
        return EXIT_USAGE
    registry = None if name in COMMANDS else discover()  # core's own commands need no plugin
    if (
        registry is not None
        and all(offer.spec.name != name for offer in registry.offers("command"))
        and package_of("command", name) is None
    ):
        names = [*(command.words for command in all_commands(registry)), *GROUPS]
        meant = nearest(spoken(name), names, f"Choose one of: {', '.join(names)}.")
        print(f"roboneuron: There is no command {spoken(name)!r}. {meant}", file=sys.stderr)
        return EXIT_USAGE
    try:
        if argv is None and name != "estop":  # must work whatever else is wrong
            keep_apart(own)
        command = ListedCommand(name=name, summary="", registry=registry)
        return run_command(command.load(), f"roboneuron {command.words}", own)
    except BrokenPipeError:  # the reader of the output has closed it, as `| head` does
        sys.stderr.close()
        return os.EX_OK
    # the border to the user of the command
    except (Exception, KeyboardInterrupt, BaseExceptionGroup) as error:
        return show_error(error)


if __name__ == "__main__":
    sys.exit(main())
