"""Commands of `roboneuron`: those of the core and of plugins, their groups, and old names."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import NamedTuple, Protocol, cast

from roboneuron.errors import PluginError
from roboneuron.plugins.availability import known_names
from roboneuron.plugins.loading import OLD_NAMES_END, load_target
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import COMMAND_SECTIONS, CommandSpec


class Command(NamedTuple):
    """Module of a core command, its one-line summary, and its section in `roboneuron --help`."""

    module: str
    summary: str
    section: str


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
        "roboneuron.cli.serve",
        "serve MCP tools for a robot (an agent's client starts this)",
        "start",
    ),
    "estop": Command(
        "roboneuron.estop.command", "stop all motion now, with or without a server", "operate"
    ),
}
"""Core command by name, in the order of `roboneuron --help`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ListedCommand:
    """A command that can be run here.

    Attributes:
        name: as its plugin offers it.
        summary: one line.
        registry: the installed plugins; None for a command of the core.
        group: word before its own word; empty for a command of the top level.
        section: of `roboneuron --help`, one of `COMMAND_SECTIONS`.
    """

    name: str
    summary: str
    registry: Registry | None
    group: str = ""
    section: str = ""

    @classmethod
    def of(cls, spec: CommandSpec, registry: Registry) -> ListedCommand:
        """The command of a plugin."""
        return cls(
            name=spec.name,
            summary=spec.summary,
            registry=registry,
            group=spec.group,
            section=spec.section,
        )

    @property
    def words(self) -> str:
        """Its name on the command line."""
        return f"{self.group} {self.word}".lstrip()

    @property
    def word(self) -> str:
        """The last of its words."""
        return self.name.removeprefix(f"{self.group}-") if self.group else self.name

    @property
    def old_options(self) -> dict[str, str]:
        """Present options by their old name; raises as `load`."""
        if self.registry is None:
            return {}
        return dict(self.registry.get(CommandSpec, self.name).old_options)

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
        ListedCommand(name=name, summary=command.summary, registry=None, section=command.section)
        for name, command in COMMANDS.items()
    ]
    specs = registry.specs(CommandSpec).values()
    installed = [
        ListedCommand.of(spec, registry)
        for spec in specs
        if spec.name not in COMMANDS and spec.group not in COMMANDS
    ]
    return (*own, *installed)


def group_names(registry: Registry) -> frozenset[str]:
    """Words that precede those of commands, of installed plugins and of the project's others."""
    offered = {spec.group for spec in _offered(registry)}
    # a hyphen of a command's name follows its group in all packages of the project
    known = {name.partition("-")[0] for name in known_names("command") if "-" in name}
    return frozenset(offered | known) - {""}


def top_level(commands: Iterable[ListedCommand]) -> dict[str, list[tuple[str, str]]]:
    """First words of command lines with a summary of each, by their section; a group's summary
    lists its actions.
    """
    found: dict[str, list[tuple[str, str]]] = {section: [] for section in COMMAND_SECTIONS}
    actions: dict[str, list[str]] = {}
    alone: set[str] = set()
    for command in commands:
        if command.group:
            actions.setdefault(command.group, []).append(command.word)
        else:
            alone.add(command.name)
            found[command.section].append((command.name, command.summary))
    for group, words in actions.items():
        if group not in alone:
            found["group"].append((group, ", ".join(sorted(words))))
    found["group"].sort()
    return {section: rows for section, rows in found.items() if rows}


def _offered(registry: Registry) -> Iterator[CommandSpec]:
    """Commands of the installed plugins, unusable ones included."""
    for offer in registry.offers("command"):
        if isinstance(offer.spec, CommandSpec):
            yield offer.spec


def present_words(
    words: Sequence[str], registry: Registry, commands: Iterable[str]
) -> tuple[list[str], str]:
    """A command line with the present name of its command, and a sentence about an old one; empty
    if the name is not old.

    Args:
        words: the command line.
        registry: the installed plugins.
        commands: first words that commands of this installation have.
    """
    renamed = {old: spec for spec in _offered(registry) for old in spec.old_names}
    spec = renamed.get(words[0])
    if spec is None or words[0] in commands:
        return list(words), ""
    now = ListedCommand.of(spec, registry).words
    return [*now.split(), *words[1:]], (
        f"`roboneuron {words[0]}` is called `roboneuron {now}` now; the old name is accepted until "
        f"{OLD_NAMES_END}."
    )


def present_options(command: ListedCommand, words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words after a command with present options, and a sentence about each old one."""
    old = command.old_options
    found, told = [], []
    for word in words:
        option, is_set, value = word.partition("=")
        now = old.get(option)
        found.append(word if now is None else f"{now}{is_set}{value}")
        if now is not None:
            told.append(
                f"{option} is called {now} now; the old name is accepted until {OLD_NAMES_END}."
            )
    return found, told
