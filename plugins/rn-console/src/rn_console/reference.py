"""The reference part of docs/command-line.md, from the commands' own parsers.

`python -m rn_console.reference docs/command-line.md` writes it anew, below the page's last line of prose.
"""

from __future__ import annotations

import sys
from argparse import Action, ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from pathlib import Path

from rn_console.parsers import whole_parser

MARK = "<!-- What follows is generated: python -m rn_console.reference docs/command-line.md -->"
_EVERYWHERE = ("--help", "--verbose", "--quiet")


def command_reference() -> str:
    """A section for each command: what it does, its arguments and options."""
    return "\n".join(_sections(whole_parser()))


def with_reference(page: str) -> str:
    """The page with its reference part made anew.

    Raises:
        ValueError: the page has no mark.
    """
    prose, mark, _ = page.partition(MARK)
    if not mark:
        raise ValueError(f"The page lacks the line {MARK!r}.")
    return f"{prose}{MARK}\n\n{command_reference()}"


def _sections(parser: ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if not isinstance(action, _SubParsersAction):
            continue
        summaries = {entry.dest: entry.help or "" for entry in action._get_subactions()}
        for name, command in action.choices.items():
            yield f"## {command.prog}\n"
            about = " ".join((command.description or summaries.get(name, "")).split())
            yield f"{about.rstrip('.')}.\n" if about else ""
            rows = [row for argument in command._actions for row in _row(argument)]
            if rows:
                yield "\n".join(["| argument | meaning |", "|---|---|", *rows]) + "\n"
            yield from _sections(command)


def _row(action: Action) -> Iterator[str]:
    if isinstance(action, _SubParsersAction) or set(action.option_strings) & set(_EVERYWHERE):
        return
    metavar = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    if not action.option_strings:
        name = f"`{value}`"
    else:
        name = ", ".join(f"`{option}{f' {value}' if value else ''}`" for option in action.option_strings)
    choices = f" (one of: {', '.join(map(str, action.choices))})" if action.choices and action.option_strings else ""
    meaning = (action.help or "").replace("%(default)s", str(action.default)).replace("|", "\\|")
    yield f"| {name} | {meaning}{choices} |"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_reference(path.read_text(encoding="utf-8")), encoding="utf-8")
