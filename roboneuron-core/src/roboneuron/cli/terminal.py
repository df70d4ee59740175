"""Terminal output at the end of a command: one line for an error, on any terminal."""

from __future__ import annotations

import codecs
import getpass
import logging
import os
import re
import sys
from argparse import SUPPRESS, ArgumentError, ArgumentParser, Namespace, _SubParsersAction
from collections.abc import Sequence
from contextlib import suppress
from io import TextIOWrapper

from roboneuron.errors import RefusedError, RoboNeuronError
from roboneuron.log_files import begin_logging, printable

TRACEBACK_VARIABLE = "ROBONEURON_TRACEBACK"
"""Environment variable that makes unexpected errors show their traceback."""
_MOST_LINE, _MOST_LINES = 2000, 40
"""Of an error shown in a terminal."""
EXIT_USAGE = 2
"""The command could not run: wrong arguments, a wrong configuration, something not installed."""
EXIT_INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells report it: 128 + SIGINT."""
EXIT_INTERNAL = os.EX_SOFTWARE
"""A defect of RoboNeuron."""
LOG_LEVELS = ("debug", "info", "warning", "error")
_QUIETNESS = re.compile(r"-v+|-q+|--verbose|--quiet")
_PLAIN = {
    "✓": "+",
    "✗": "x",
    "…": "...",
    "→": "->",
    "≥": ">=",
    "≤": "<=",
    "“": '"',
    "”": '"',
    "°": "deg",
    "µ": "u",
}
"""Replacements for characters that the terminal's encoding lacks; a question mark for all
others.
"""


def accept_any_text() -> None:
    """Make standard output and error replace characters that their encoding lacks, instead of
    failing.
    """
    codecs.register_error("roboneuron", _replace)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="roboneuron")


def _replace(error: UnicodeError) -> tuple[str, int]:
    """Return the replacement and the position to continue at; see `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(
        _PLAIN.get(letter, "?") for letter in error.object[error.start : error.end]
    ), error.end


def add_verbosity(parser: ArgumentParser, default: object = 0) -> None:
    """Add -v and -q to a command's parser and to those of its subcommands; options of the command
    itself win.

    Args:
        parser: parser of the command.
        default: count without these options.
    """
    for short, name, meaning in (("-v", "--verbose", "more"), ("-q", "--quiet", "less")):
        with suppress(ArgumentError):
            parser.add_argument(
                short,
                name,
                action="count",
                default=default,
                help=f"log {meaning} to standard error; may be repeated",
            )
    for action in parser._actions:
        if isinstance(action, _SubParsersAction):
            for subparser in action.choices.values():
                # a default would overwrite the options before the subcommand
                add_verbosity(subparser, SUPPRESS)


def with_verbosity_behind(words: Sequence[str]) -> list[str]:
    """Move -v and -q from before the command's name to behind it."""
    first = next((i for i, word in enumerate(words) if not _QUIETNESS.fullmatch(word)), 0)
    return [*words[first : first + 1], *words[:first], *words[first + 1 :]]


def log_level(arguments: Namespace, level: str = "warning") -> str:
    """The log level that a command line requests.

    Args:
        arguments: with the counts of -v and -q.
        level: lowered by each -v and raised by each -q, within `LOG_LEVELS`.
    """
    steps = _count(arguments, "quiet") - _count(arguments, "verbose")
    return LOG_LEVELS[min(max(LOG_LEVELS.index(level) + steps, 0), len(LOG_LEVELS) - 1)]


def apply_verbosity(arguments: Namespace) -> None:
    """Configure logging to standard error by -v and -q; a command with --log-level configures its
    log itself.
    """
    if isinstance(level := getattr(arguments, "log_level", None), str):
        arguments.log_level = log_level(arguments, level)
    elif _count(arguments, "quiet") or _count(arguments, "verbose"):
        begin_logging(log_level(arguments).upper())
        logging.captureWarnings(True)


def _count(arguments: Namespace, name: str) -> int:
    value = getattr(arguments, name, 0)
    return value if isinstance(value, int) else 0


def show_error(error: BaseException) -> int:
    """Print the cause of a command's end in one line, and return its exit status.

    In a group of exceptions a deliberate one takes precedence: task groups wrap every exception
    raised inside them.

    Args:
        error: the exception that ended the command.
    """
    if os.environ.get(TRACEBACK_VARIABLE):
        import traceback

        traceback.print_exception(error)
    leaves = _leaves(error)
    if any(isinstance(leaf, KeyboardInterrupt) for leaf in leaves):
        return EXIT_INTERRUPTED
    cause = next((leaf for leaf in leaves if isinstance(leaf, RoboNeuronError)), leaves[0])
    if isinstance(cause, RoboNeuronError):
        print(f"roboneuron: {_shown(str(cause))}", file=sys.stderr)
        return EXIT_USAGE
    if isinstance(cause, OSError):
        place = f"{cause.filename}: " if cause.filename else ""
        told = printable(f"{place}{str(cause.strerror or cause).rstrip('.')}", _MOST_LINE)
        print(f"roboneuron: {told}.", file=sys.stderr)
        return EXIT_USAGE
    words = str(cause).strip().splitlines() or ["no message"]
    what = f"an unexpected {type(cause).__name__}: {_shown(words[0].rstrip('.'))}"
    print(
        f"roboneuron: {what}. Set {TRACEBACK_VARIABLE}=1 to see where, and report it.",
        file=sys.stderr,
    )
    return EXIT_INTERNAL


def _shown(text: str) -> str:
    """An error's text for the terminal: it may quote a client, a file or a server. Our own lines
    stay lines.
    """
    return "\n".join(printable(line, _MOST_LINE) for line in text.split("\n")[:_MOST_LINES])


def ask(question: str) -> str:
    """A person's answer to a question in the terminal, in lower case; empty at the end of the
    input.
    """
    try:
        return input(question).strip().lower()
    except EOFError:
        print()  # the question's line
        return ""


def is_agreed(question: str) -> bool:
    """True if a person answers with yes."""
    return ask(f"{question} [y/N] ") in ("y", "yes")


def ask_hidden(question: str) -> str:
    """A line typed without being shown, such as a PIN.

    Raises:
        RefusedError: the input has ended.
    """
    try:
        return getpass.getpass(question)
    except EOFError as error:
        raise RefusedError(
            f"The input ended before an answer to {question.strip()!r}; nothing was changed.",
            hint="Type the answer in a terminal.",
            rule="person",
        ) from error


def _leaves(error: BaseException) -> list[BaseException]:
    """The exceptions in a group and its subgroups; for another exception itself."""
    if isinstance(error, BaseExceptionGroup):
        return [leaf for part in error.exceptions for leaf in _leaves(part)]
    return [error]
