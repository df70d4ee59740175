"""`roboneuron`: chooses the command, imports its module, shows deliberate errors in one
sentence.
"""

from __future__ import annotations

import os
import sys
from argparse import SUPPRESS, ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence

from roboneuron import __version__
from roboneuron.cli.commands import (
    COMMANDS,
    GROUPS,
    PLUGINS_LIST,
    installed_commands,
    list_plugins,
    load_command,
    named_command,
    run_command,
    spoken,
)
from roboneuron.cli.terminal import EXIT_USAGE, accept_any_text, show_error, with_verbosity_behind
from roboneuron.errors import nearest
from roboneuron.plugins.availability import package_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry


def build_parser(registry: Registry, group: str = "") -> ArgumentParser:
    """The parser of `roboneuron` itself, or of a group of its commands; they are listed, not
    imported.
    """
    summaries = {name: command.summary for name, command in COMMANDS.items()} | installed_commands(
        registry
    )
    listed = {
        spoken(name): text
        for name, text in summaries.items()
        if spoken(name).startswith(f"{group} ".lstrip())
    }
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
    """Run one command line and return its exit status."""
    accept_any_text()
    words = with_verbosity_behind(sys.argv[1:] if argv is None else argv)
    name, own = named_command(words) if words else ("", [])
    if not name or name.startswith("-") or name in GROUPS:
        is_group = name in GROUPS
        parser = build_parser(discover(), name if is_group else "")
        parser.parse_args(own if is_group else words)  # --help and --version end here
        parser.print_help(sys.stderr)
        return EXIT_USAGE
    registry = None if name in COMMANDS else discover()  # core's own commands need no plugin
    if registry is not None and not _is_known(name, registry):
        names = [*map(spoken, [*COMMANDS, *installed_commands(registry)]), *GROUPS]
        meant = nearest(spoken(name), names, f"Choose one of: {', '.join(names)}.")
        print(f"roboneuron: There is no command {spoken(name)!r}. {meant}", file=sys.stderr)
        return EXIT_USAGE
    if (
        registry is not None
        and name == PLUGINS_LIST
        and not own
        and name not in installed_commands(registry)
    ):
        print(list_plugins(registry))
        return os.EX_OK
    try:
        return run_command(load_command(name, registry), f"roboneuron {spoken(name)}", own)
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        sys.stderr.close()
        return os.EX_OK
    except (
        Exception,
        KeyboardInterrupt,
        BaseExceptionGroup,
    ) as error:  # the border to whoever typed the command
        return show_error(error)


def _is_known(name: str, registry: Registry) -> bool:
    """An installed plugin offers the command, or it is known which package does."""
    return (
        any(o.spec.name == name for o in registry.offers("command"))
        or package_of("command", name) is not None
    )


if __name__ == "__main__":
    sys.exit(main())
