"""Generator of the reference part of docs/command-line.md, from the commands' parsers.

`python -m rn_standard.console.reference docs/command-line.md` rewrites it, below the page's last
line of prose.
"""

from __future__ import annotations

import sys
from argparse import Action, ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from pathlib import Path

from rn_standard.console.parsers import ONLY_ACTIONS, whole_parser

MARK = (
    "<!-- What follows is generated: python -m rn_standard.console.reference "
    "docs/command-line.md -->"
)
_EVERYWHERE = ("--help", "--verbose", "--quiet")


def command_reference() -> str:
    """Create a section for each command: its purpose, and the names of its arguments and
    options.
    """
    return "\n".join(_section(command) for command in _commands(whole_parser()) if _about(command))


def with_reference(page: str) -> str:
    """Return the page with a regenerated reference part.

    Raises:
        ValueError: the page has no mark.
    """
    prose, mark, _ = page.partition(MARK)
    if not mark:
        raise ValueError(f"The page lacks the line {MARK!r}.")
    return f"{prose}{MARK}\n\n{command_reference()}"


def _commands(parser: ArgumentParser) -> Iterator[ArgumentParser]:
    """Every command, each group before its actions."""
    for action in parser._actions:
        if isinstance(action, _SubParsersAction):
            summaries = {entry.dest: entry.help or "" for entry in action._get_subactions()}
            for name, command in action.choices.items():
                command.description = command.description or summaries.get(name)
                yield command
                yield from _commands(command)


def _about(command: ArgumentParser) -> str:
    """Purpose of a command, from its first paragraph; empty for a word that only precedes its
    actions.
    """
    about = " ".join((command.description or "").partition("\n\n")[0].split()).rstrip(".")
    return "" if about == ONLY_ACTIONS else about[:1].upper() + about[1:]


def _section(command: ArgumentParser) -> str:
    names = [f"`{name}`" for action in command._actions for name in _name(action)]
    lines = [f"## {command.prog}\n", f"{_about(command)}.\n"]
    return "\n".join([*lines, *([f"{' '.join(names)}\n"] if names else [])])


def _name(action: Action) -> Iterator[str]:
    if isinstance(action, _SubParsersAction) or set(action.option_strings) & set(_EVERYWHERE):
        return
    metavar = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    if action.choices and action.option_strings:
        value = "|".join(map(str, action.choices))
    option = max(action.option_strings, key=len, default="")
    yield (" " if isinstance(metavar, tuple) else "=").join(filter(None, (option, value)))


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_reference(path.read_text(encoding="utf-8")), encoding="utf-8")
