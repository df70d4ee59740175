"""The reference part of docs/command-line.md, from the commands' own parsers.

`python -m rn_standard.console.reference docs/command-line.md` writes it anew, below the page's last
line of prose.
"""

from __future__ import annotations

import sys
from argparse import Action, ArgumentParser, _SubParsersAction
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from rn_standard.console.parsers import ONLY_ACTIONS, whole_parser

MARK = (
    "<!-- What follows is generated: python -m rn_standard.console.reference "
    "docs/command-line.md -->"
)
_EVERYWHERE = ("--help", "--verbose", "--quiet")
_MANY = 3
"""Commands from which on an option that means the same in all is explained once."""


def command_reference() -> str:
    """A section for each command: what it does, its arguments and options; those of many
    commands come first.
    """
    parser = whole_parser()
    counts = Counter(row for command in _commands(parser) for row in _rows(command))
    meanings = {
        _name(row): row
        for row, count in sorted(counts.items(), key=lambda item: item[1])
        if count >= _MANY
    }
    shared = [row for row in counts if row in meanings.values()]
    first = ["## Options of many commands\n", "\n".join(shared) + "\n"]
    return "\n".join(
        [*first, *(_section(command, shared) for command in _commands(parser) if _about(command))]
    )


def with_reference(page: str) -> str:
    """The page with its reference part made anew.

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
    """What a command does; empty for a word that only stands before its actions."""
    about = " ".join((command.description or "").split()).rstrip(".")
    return "" if about == ONLY_ACTIONS else about


def _section(command: ArgumentParser, shared: Collection[str]) -> str:
    rows = _rows(command)
    lines = [f"## {command.prog}\n", f"{_about(command)}.\n"]
    own = [row for row in rows if row not in shared]
    if own:
        lines.append("\n".join(own) + "\n")
    if len(own) < len(rows):
        lines.append(f"Also {', '.join(_name(row) for row in rows if row in shared)}.\n")
    return "\n".join(lines)


def _name(row: str) -> str:
    return row[2:].partition(": ")[0]


def _rows(command: ArgumentParser) -> list[str]:
    return [row for argument in command._actions for row in _row(argument)]


def _row(action: Action) -> Iterator[str]:
    if isinstance(action, _SubParsersAction) or set(action.option_strings) & set(_EVERYWHERE):
        return
    metavar = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    if not action.option_strings:
        name = f"`{value}`"
    else:
        name = ", ".join(
            f"`{option}{f' {value}' if value else ''}`" for option in action.option_strings
        )
    choices = (
        f" (one of: {', '.join(map(str, action.choices))})"
        if action.choices and action.option_strings
        else ""
    )
    meaning = (action.help or "").replace("%(default)s", str(action.default))
    yield f"- {name}: {meaning}{choices}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_reference(path.read_text(encoding="utf-8")), encoding="utf-8")
