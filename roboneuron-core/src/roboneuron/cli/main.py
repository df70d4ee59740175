"""The `roboneuron` command: runs one command of core or of a plugin, and shows deliberate errors in
one sentence.
"""

from __future__ import annotations

import os
import sys
from argparse import (
    SUPPRESS,
    ArgumentParser,
    RawDescriptionHelpFormatter,
    _SubParsersAction,
)
from collections.abc import Iterable, Sequence

from roboneuron import __version__
from roboneuron.cli.listing import (
    COMMANDS,
    CommandModule,
    ListedCommand,
    all_commands,
    group_names,
    present_options,
    present_words,
    top_level,
)
from roboneuron.cli.terminal import (
    EXIT_USAGE,
    accept_any_text,
    add_verbosity,
    apply_verbosity,
    show_error,
    with_verbosity_behind,
)
from roboneuron.errors import ConfigurationError, MissingDependencyError, nearest
from roboneuron.plugins.availability import install_command, known_names, package_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry
from roboneuron.ros.installation import keep_apart

_MOST_PORT = 65535
_ABOUT = (
    "Typed MCP tools and supervised closed loops between LLM agents, ROS 2 robots and VLA models."
)
_HEADINGS = {
    "start": "start",
    "operate": "operate a robot",
    "group": "groups of commands",
    "": "more",
}
"""Headings of `roboneuron --help` by section."""


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


def own_actions(parser: ArgumentParser) -> _SubParsersAction[ArgumentParser] | None:
    """The actions that a command declares itself; None without any."""
    return next((a for a in parser._actions if isinstance(a, _SubParsersAction)), None)


def run_command(
    command: CommandModule,
    prog: str,
    words: Sequence[str],
    others: Iterable[ListedCommand] = (),
) -> int:
    """Parse the words after `prog`, run the command and return its exit status.

    Args:
        command: configures the parser, and runs.
        prog: name of the command in its help.
        words: the remaining words of the command line.
        others: commands that plugins add to the group of this name; the command's own actions
            come first.
    """
    parser = ArgumentParser(prog=prog, description=command.__doc__)
    configure(command, parser, words)
    if actions := own_actions(parser):
        for other in others:
            if other.word not in actions.choices:
                actions.add_parser(other.word, help=other.summary)
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
        group: of `group_names`, or empty for the top level.

    Raises:
        MissingDependencyError: no installed package has an action of the group.
    """
    commands = all_commands(registry)
    if group:
        rows = sorted((c.words, c.summary) for c in commands if c.group == group)
        sections = {"commands": rows}
        last = f"`roboneuron {group} ACTION --help` explains one of them."
    else:
        sections = {_HEADINGS[name]: rows for name, rows in top_level(commands).items()}
        last = "`roboneuron COMMAND --help` explains a command, or lists those of a group."
    if group and not rows:
        bringing = {p for n, p in known_names("command").items() if n.startswith(f"{group}-")}
        raise MissingDependencyError(
            f"No installed package has an action of `roboneuron {group}`.",
            hint=f"Run: {install_command(*sorted(bringing))}.",
        )
    width = max(len(name) for rows in sections.values() for name, _ in rows)
    tables = "\n\n".join(
        "\n".join([f"{heading}:", *(f"  {name:<{width}}  {summary}" for name, summary in rows)])
        for heading, rows in sections.items()
    )
    parser = ArgumentParser(
        prog="roboneuron",
        usage=f"roboneuron {group or 'COMMAND'} {'ACTION ' if group else ''}[options]",
        description=None if group else _ABOUT,
        epilog=f"{tables}\n\n{last}",
        formatter_class=RawDescriptionHelpFormatter,
    )
    if not group:
        parser.add_argument("--version", action="version", version=f"roboneuron {__version__}")
    parser.add_argument("command", metavar="COMMAND", nargs="?", help=SUPPRESS)
    return parser


def split_action(words: Sequence[str]) -> tuple[str, list[str]]:
    """The action of a group in the words after it, empty without one, and the other words.

    Options may stand before it: `plugins --config FILE list`.
    """
    own = list(words)
    for i, word in enumerate(own):
        if not word.startswith("-") and own[i - 1 : i] != ["--config"]:
            return own.pop(i), own
    return "", own


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status.

    Args:
        argv: the words after `roboneuron`; those of this process by default.
    """
    accept_any_text()
    words = with_verbosity_behind(sys.argv[1:] if argv is None else argv)
    try:
        if not words or words[0].startswith("-"):
            return _show_help(build_parser(discover()), words)
        if words[0] in COMMANDS:  # core's own commands need no plugin
            command = ListedCommand(name=words[0], summary="", registry=None)
            return _run(command, words[1:], is_typed=argv is None)
        return _run_of_plugin(words, is_typed=argv is None)
    except BrokenPipeError:  # the reader of the output has closed it, as `| head` does
        sys.stderr.close()
        return os.EX_OK
    # the border to the user of the command
    except (Exception, KeyboardInterrupt, BaseExceptionGroup) as error:
        return show_error(error)


def _show_help(parser: ArgumentParser, words: Sequence[str]) -> int:
    """Answer a command line without a command, or a group without an action."""
    parser.parse_args(words)  # --help and --version end here
    parser.print_help(sys.stderr)
    return EXIT_USAGE


def _run(
    command: ListedCommand,
    words: Sequence[str],
    others: Iterable[ListedCommand] = (),
    *,
    is_typed: bool,
) -> int:
    if is_typed and command.name != "estop":  # must work whatever else is wrong
        keep_apart(words)
    words, told = present_options(command, words)
    for sentence in told:
        print(f"roboneuron: {sentence}", file=sys.stderr)
    return run_command(command.load(), f"roboneuron {command.words}", words, others)


def _run_of_plugin(words: Sequence[str], *, is_typed: bool) -> int:
    """Run a command that a plugin brings, on the top level or in a group."""
    registry = discover()
    offered = {offer.spec.name for offer in registry.offers("command")}
    groups = group_names(registry)
    words, told = present_words(words, registry, offered | groups)
    if told:
        print(f"roboneuron: {told}", file=sys.stderr)
    first, *own = words
    action, rest = split_action(own) if first in groups else ("", own)
    name = f"{first}-{action}" if action else ""
    others = [command for command in all_commands(registry) if command.group == first]
    main_command = ListedCommand(name=first, summary="", registry=registry)
    if _is_known(name, offered) and not (first in offered and _is_own(action, main_command)):
        command = ListedCommand(name=name, summary="", registry=registry, group=first)
        return _run(command, rest, is_typed=is_typed)
    if first in offered or (_is_known(first, offered) and (action or not others)):
        return _run(main_command, own, others, is_typed=is_typed)
    if first in groups and not action:
        return _show_help(build_parser(registry, first), own)
    names = [command.words for command in all_commands(registry)]
    typed = f"{first} {action}".rstrip()
    meant = nearest(typed, [*names, *groups], f"Choose one of: {', '.join(sorted(names))}.")
    raise ConfigurationError(f"There is no command {typed!r}. {meant}")


def _is_known(name: str, offered: Iterable[str]) -> bool:
    """True for a command of an installed plugin, or of a package of the project."""
    return name in offered or package_of("command", name) is not None


def _is_own(action: str, command: ListedCommand) -> bool:
    """True if a command declares that action itself."""
    parser = ArgumentParser(add_help=False)
    command.load().configure(parser)
    actions = own_actions(parser)
    return actions is not None and action in actions.choices


if __name__ == "__main__":
    sys.exit(main())
