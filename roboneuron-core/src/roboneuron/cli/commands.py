"""The commands: those of core, and those that plugins offer.

A command called `plugins-list` is used as `roboneuron plugins list`: its group, then its action.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from importlib import import_module
from typing import NamedTuple, Protocol, cast

from roboneuron.cli.terminal import add_verbosity, apply_verbosity
from roboneuron.errors import PluginError
from roboneuron.plugins.availability import WHOLE, install_command, package_of
from roboneuron.plugins.loading import load_target
from roboneuron.plugins.registry import Registry, Status


class Command(NamedTuple):
    """Where a command of core lives and what it does in one line."""

    module: str
    summary: str


class CommandModule(Protocol):
    """What the module of a command of core holds, and what a plugin's command is an instance of."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the command's arguments to its parser."""
        ...

    def run(self, arguments: Namespace) -> int:
        """Do it and return the exit status; a RoboNeuronError is shown by `main` and ends with
        status 2.
        """
        ...


COMMANDS: dict[str, Command] = {
    "serve": Command(
        "roboneuron.cli.serve", "serve MCP tools for a robot (an agent's client starts this)"
    ),
    "estop": Command("roboneuron.cli.estop", "stop all motion now, with or without a server"),
}
"""Command by name, in the order of `roboneuron --help`."""
GROUPS = ("config", "plugins")
"""Words that stand before the actions of several commands."""


PLUGINS_LIST = "plugins-list"
"""The command that core answers itself where the package that does so in full is not installed."""


def list_plugins(registry: Registry) -> str:
    """What is installed, whether it can be used, and what to do about the rest."""
    lines = []
    for record in registry.plugins:
        offers = ", ".join(f"{offer.spec.kind} {offer.spec.name}" for offer in record.offers)
        lines.append(f"{record.name} {record.version}: {record.status}: {offers}".rstrip(": "))
        lines += [f"  {record.reason}"] if record.reason else []
    if not lines:
        lines = [f"No plugins are installed. For a start: {install_command(WHOLE)}"]
    package = package_of("command", PLUGINS_LIST)
    return "\n".join(
        [*lines, f"Options and details of this command: {install_command(package or '')}"]
    )


def spoken(name: str) -> str:
    """A command's name as it is written on the command line."""
    return name.replace("-", " ", 1) if name.partition("-")[0] in GROUPS else name


def named_command(words: Sequence[str]) -> tuple[str, list[str]]:
    """The name of the command that a command line means, and the words that are the command's own.

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


def installed_commands(registry: Registry) -> dict[str, str]:
    """Summary by name of the commands that plugins offer and that can be used; one of core's name
    is left out.
    """
    return {
        offer.spec.name: offer.spec.summary
        for offer in registry.offers("command")
        if offer.status is Status.READY and offer.spec.name not in COMMANDS
    }


def load_command(name: str, registry: Registry | None = None) -> CommandModule:
    """Import a command.

    Raises:
        ConfigurationError: no installed plugin offers it, or the plugin cannot be used; says why.
        PluginError, MissingDependencyError: it cannot be loaded.
    """
    if registry is None:
        return cast(CommandModule, import_module(COMMANDS[name].module))
    target = load_target(registry.get("command", name))
    if not callable(target):
        raise PluginError(f"The target of command {name!r} is {target!r}, expected a class.")
    command = target()
    if not (
        callable(getattr(command, "configure", None)) and callable(getattr(command, "run", None))
    ):
        raise PluginError(
            f"The command {name!r} is {command!r}, expected the methods configure and run."
        )
    return cast(CommandModule, command)


def run_command(command: CommandModule, prog: str, words: Sequence[str]) -> int:
    """Parse the words after `prog` as the command says, run it and return its exit status."""
    parser = ArgumentParser(prog=prog, description=command.__doc__)
    command.configure(parser)
    add_verbosity(parser)
    add_installed = getattr(command, "add_installed_flags", None)
    # Discovery imports every plugin, so it waits until somebody asks for more than core's own
    # flags.
    if add_installed is not None and (
        {"-h", "--help"} & set(words) or parser.parse_known_args(words)[1]
    ):
        add_installed(parser)
    arguments = parser.parse_args(words)
    apply_verbosity(arguments)
    return command.run(arguments)
