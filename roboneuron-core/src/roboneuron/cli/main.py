"""`roboneuron`: chooses the command, imports its module, shows deliberate errors in one sentence."""

from __future__ import annotations

import sys
from argparse import SUPPRESS, ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from typing import cast

from roboneuron import __version__
from roboneuron.cli.commands import COMMANDS, CommandModule
from roboneuron.cli.terminal import EXIT_USAGE, accept_any_text, show_error

EXIT_OK = 0
"""It is as asked."""
EXIT_FAILED = 1
"""The command ran and its answer is no (a check failed, a plugin is not ready)."""


def build_parser() -> ArgumentParser:
    """The parser of `roboneuron` itself; commands are listed, not imported."""
    width = max(len(name) for name in COMMANDS)
    table = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items())
    parser = ArgumentParser(
        prog="roboneuron",
        usage="roboneuron COMMAND [options]",
        description="Typed MCP tools and supervised closed loops between LLM agents, ROS 2 robots and VLA models.",
        epilog=f"commands:\n{table}\n\n`roboneuron COMMAND --help` explains one of them.",
        formatter_class=RawDescriptionHelpFormatter,
        add_help=True,
    )
    parser.add_argument("--version", action="version", version=f"roboneuron {__version__}")
    parser.add_argument("command", metavar="COMMAND", nargs="?", help=SUPPRESS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status."""
    accept_any_text()
    words = list(sys.argv[1:] if argv is None else argv)
    parser = build_parser()
    if not words or words[0].startswith("-"):
        parser.parse_args(words)  # --help and --version end here
        parser.print_help(sys.stderr)
        return EXIT_USAGE
    name, *rest = words
    if name not in COMMANDS:
        close = get_close_matches(name, COMMANDS, n=1)
        nearest = f"did you mean {close[0]!r}?" if close else f"choose one of: {', '.join(COMMANDS)}."
        print(f"roboneuron: there is no command {name!r}; {nearest}", file=sys.stderr)
        return EXIT_USAGE
    try:
        module = cast(CommandModule, import_module(COMMANDS[name].module))
        command_parser = ArgumentParser(prog=f"roboneuron {name}", description=module.__doc__)
        module.configure(command_parser)
        return module.run(command_parser.parse_args(rest))
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        sys.stderr.close()
        return EXIT_OK
    except (Exception, KeyboardInterrupt, BaseExceptionGroup) as error:  # the border to whoever typed the command
        return show_error(error)


if __name__ == "__main__":
    sys.exit(main())
