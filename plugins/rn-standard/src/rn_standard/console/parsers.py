"""All commands of `roboneuron` in one argument parser, for completion and the reference page."""

from __future__ import annotations

import logging
from argparse import Action, ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from pathlib import Path

import shtab

from roboneuron import RoboNeuronError
from roboneuron.command import all_commands, configure, discover

log = logging.getLogger(__name__)
_FOLDERS = ("DIRECTORY", "FOLDER")
ONLY_ACTIONS = "see its actions"
"""Help of a word that only precedes actions."""


def whole_parser() -> ArgumentParser:
    """Create the parser of all commands; a plugin's command that cannot be loaded is logged and
    left out.
    """
    parser = ArgumentParser(prog="roboneuron")
    parser.add_argument(
        "--version", action="store_true", help="show program's version number and exit"
    )
    commands = parser.add_subparsers(dest="command")
    # a group's own command comes first: the others are added to its actions
    for listed in sorted(all_commands(discover()), key=lambda one: one.words):
        try:
            module = listed.load()
        except RoboNeuronError as error:
            log.warning("The command %s is left out: %s", listed.words, error)
            continue
        holder = _actions_of(listed.group, commands) if listed.group else commands
        if listed.word not in holder.choices:
            command = holder.add_parser(
                listed.word, help=listed.summary, description=module.__doc__
            )
            configure(module, command)
    for action in _actions(parser):
        if action.type is Path and not action.choices:
            is_folder = action.metavar in _FOLDERS
            action.complete = shtab.DIRECTORY if is_folder else shtab.FILE  # type: ignore[attr-defined]
    return parser


def _actions_of(
    group: str, commands: _SubParsersAction[ArgumentParser]
) -> _SubParsersAction[ArgumentParser]:
    parser = commands.choices.get(group) or commands.add_parser(group, help=ONLY_ACTIONS)
    own = next((a for a in parser._actions if isinstance(a, _SubParsersAction)), None)
    return own or parser.add_subparsers(dest="action")


def _actions(parser: ArgumentParser) -> Iterator[Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, _SubParsersAction):
            for subparser in action.choices.values():
                yield from _actions(subparser)
