"""-v and -q set the log level, at any position."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace

import pytest

from roboneuron.cli import terminal
from roboneuron.cli.listing import COMMANDS, ListedCommand


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["-v", "-q", "config", "show"], ["config", "-v", "-q", "show"]),
        (["config", "show", "-v"], ["config", "show", "-v"]),
        (["--version"], ["--version"]),
        (["-vv"], ["-vv"]),
        ([], []),
    ],
)
def test_flags_before_the_command_belong_to_it(words: list[str], expected: list[str]) -> None:
    assert terminal.with_verbosity_behind(words) == expected


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_takes_v_and_q(name: str) -> None:
    parser = ArgumentParser()
    ListedCommand(name=name, summary="", registry=None).load().configure(parser)
    terminal.add_verbosity(parser)
    assert "--verbose" in parser.format_help()
    assert "--quiet" in parser.format_help()


def test_subcommands_take_them_too() -> None:
    parser = ArgumentParser()
    parser.add_subparsers().add_parser("show")
    terminal.add_verbosity(parser)
    assert parser.parse_args(["-v", "show"]).verbose == 1
    assert parser.parse_args(["show", "-v"]).verbose == 1
    assert parser.parse_args(["show"]).verbose == 0


def test_a_commands_own_options_win() -> None:
    parser = ArgumentParser()
    parser.add_argument("-v", "--volume", type=int)
    terminal.add_verbosity(parser)
    arguments = parser.parse_args(["-v", "3", "-q"])
    assert (arguments.volume, arguments.quiet) == (3, 1)
    assert terminal.log_level(arguments) == "error"


@pytest.mark.parametrize(
    ("verbose", "quiet", "level", "expected"),
    [
        (0, 0, "warning", "warning"),
        (1, 0, "warning", "info"),
        (5, 0, "warning", "debug"),
        (0, 1, "info", "warning"),
        (0, 9, "info", "error"),
        (1, 1, "info", "info"),
    ],
)
def test_levels_move_by_steps(verbose: int, quiet: int, level: str, expected: str) -> None:
    assert terminal.log_level(Namespace(verbose=verbose, quiet=quiet), level) == expected


def test_a_command_with_a_log_level_of_its_own_begins_its_log_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(terminal, "begin_logging", lambda level: pytest.fail("begun twice"))
    arguments = Namespace(verbose=1, quiet=0, log_level="info")
    terminal.apply_verbosity(arguments)
    assert arguments.log_level == "debug"


def test_nothing_changes_without_the_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    monkeypatch.setattr(terminal, "begin_logging", begun.append)
    monkeypatch.setattr(logging, "captureWarnings", lambda _: None)
    terminal.apply_verbosity(Namespace(verbose=0, quiet=0))
    assert begun == []
    terminal.apply_verbosity(Namespace(verbose=1, quiet=0))
    assert begun == ["INFO"]
