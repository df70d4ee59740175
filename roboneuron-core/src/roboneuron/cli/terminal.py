"""What a person sees of a command's end: one line for an error, on any terminal."""

from __future__ import annotations

import codecs
import os
import sys
from io import TextIOWrapper

from roboneuron.errors import RoboNeuronError

TRACEBACK_VARIABLE = "ROBONEURON_TRACEBACK"
"""Environment variable: when set, an unexpected error is shown with its traceback."""
EXIT_USAGE = 2
"""The command could not run: wrong arguments, a wrong configuration, something not installed."""
EXIT_INTERRUPTED = 130
EXIT_INTERNAL = os.EX_SOFTWARE
"""A defect of RoboNeuron."""
_PLAIN = {"✓": "+", "✗": "x", "…": "...", "→": "->", "≥": ">=", "≤": "<=", "“": '"', "”": '"', "°": "deg", "µ": "u"}
"""What stands for a letter that the terminal's encoding lacks; a question mark for all others."""


def accept_any_text() -> None:
    """Let standard output and error show what their encoding lacks by something similar, instead of failing."""
    codecs.register_error("roboneuron", _replace)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="roboneuron")


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(letter, "?") for letter in error.object[error.start : error.end]), error.end


def show_error(error: BaseException) -> int:
    """Print why a command ended, in one line, and return its exit status.

    Of a group of exceptions a deliberate one counts: task groups wrap whatever is raised inside of them.
    """
    if os.environ.get(TRACEBACK_VARIABLE):
        import traceback

        traceback.print_exception(error)
    leaves = _leaves(error)
    if any(isinstance(leaf, KeyboardInterrupt) for leaf in leaves):
        return EXIT_INTERRUPTED
    cause = next((leaf for leaf in leaves if isinstance(leaf, RoboNeuronError)), leaves[0])
    if isinstance(cause, RoboNeuronError):
        print(f"roboneuron: {cause}", file=sys.stderr)
        return EXIT_USAGE
    if isinstance(cause, OSError):
        place = f"{cause.filename}: " if cause.filename else ""
        print(f"roboneuron: {place}{str(cause.strerror or cause).rstrip('.')}.", file=sys.stderr)
        return EXIT_USAGE
    words = str(cause).strip().splitlines() or ["no message"]
    what = f"an unexpected {type(cause).__name__}: {words[0].rstrip('.')}"
    print(f"roboneuron: {what}. Set {TRACEBACK_VARIABLE}=1 to see where, and report it.", file=sys.stderr)
    return EXIT_INTERNAL


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for part in error.exceptions for leaf in _leaves(part)]
    return [error]
