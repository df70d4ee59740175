"""Old names of commands and of their options, which their plugin declares."""

from __future__ import annotations

import ast
from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from pathlib import Path

import pytest

import roboneuron.cli
from roboneuron import CommandSpec
from roboneuron.cli.listing import ListedCommand, all_commands, present_options
from roboneuron.cli.main import main
from roboneuron.plugins.discovery import discover


def specs() -> dict[str, CommandSpec]:
    """Installed commands by their words."""
    registry = discover()
    offered = registry.specs(CommandSpec).values()
    return {ListedCommand.of(spec, registry).words: spec for spec in offered}


POLISHER = """
class Polisher:
    \"\"\"Polish.\"\"\"
    def configure(self, parser):
        parser.add_argument("--max-s")
    def run(self, arguments):
        print("polished for", arguments.max_s)
        return 0

@hookimpl
def roboneuron_commands():
    return [
        CommandSpec(
            name="robot-polish", group="robot", summary="polishes", target="rn_kit_plugin:Polisher",
            old_names=("polish", "serve", "robot"), old_options=(("--time", "--max-s"),),
        )
    ]
"""


@pytest.fixture
def only(site, monkeypatch):
    """Make the command line see only the plugins of the test's site."""
    monkeypatch.setattr("roboneuron.cli.main.discover", site.discover)
    return site


@pytest.mark.parametrize(
    ("words", "notes"),
    [
        ("robot polish --max-s 3", []),
        ("polish --max-s=3", ["`roboneuron polish` is called `roboneuron robot polish` now"]),
        ("robot polish --time 3", ["--time is called --max-s now"]),
        (
            "polish --time=3",
            [
                "`roboneuron polish` is called `roboneuron robot polish` now",
                "--time is called --max-s now",
            ],
        ),
    ],
)
def test_a_plugins_command_is_run_by_its_old_names(only, capsys, words, notes):
    only.install("rn-kit", POLISHER)
    assert main(words.split()) == 0
    shown = capsys.readouterr()
    assert shown.out == "polished for 3\n"
    assert [line.partition("; ")[0] for line in shown.err.splitlines()] == [
        f"roboneuron: {note}" for note in notes
    ]


def test_a_present_name_comes_before_an_old_one(only, capsys):
    present = POLISHER.replace('name="robot-polish", group="robot"', 'name="polish"')
    only.install("rn-other", present.replace("rn_kit", "rn_other").replace("old_names", "# "))
    only.install("rn-kit", POLISHER)
    assert main(["polish", "--max-s", "3"]) == 0
    assert capsys.readouterr() == ("polished for 3\n", "")


@pytest.mark.parametrize(
    "fields",
    [
        'old_names=("Robot",)',
        'old_names=("robot polish",)',
        'old_names="polish"',
        'old_options=(("--time",),)',
        'old_options=(("time", "--max-s"),)',
        'old_options={"--time": "--max-s"}',
    ],
)
def test_a_wrong_old_name_is_refused(only, fields):
    spec = f'CommandSpec(name="polish", summary="s", target="rn_kit_plugin:Polisher", {fields})'
    only.install("rn-kit", f"@hookimpl\ndef roboneuron_commands():\n    return [{spec}]\n")
    [record] = only.discover().plugins
    assert record.status == "failed"
    assert fields.partition("=")[0].replace("_", " ").rstrip("s") in record.reason.replace("_", " ")


def test_old_names_of_this_project_do_the_same(capsys):
    installed = specs()
    first_words = {words.split()[0] for words in installed}
    old_names = [(old, words) for words, spec in installed.items() for old in spec.old_names]
    assert not first_words & {old for old, _ in old_names}
    assert len({old for old, _ in old_names}) == len(old_names) > 0
    for old, now in old_names:
        helped = []
        for name in (old, now):
            with pytest.raises(SystemExit) as ended:
                main([*name.split(), "--help"])
            assert ended.value.code == 0
            helped.append(capsys.readouterr())
        assert helped[0].out == helped[1].out
        assert helped[1].err == ""
        [told] = helped[0].err.splitlines()
        assert f"`roboneuron {now}`" in told


def test_old_options_of_this_project_do_the_same():
    count = 0
    for listed in all_commands(discover()):
        if not listed.old_options:
            continue
        parser = ArgumentParser()
        listed.load().configure(parser)
        options = set(options_of(parser))
        for old, now in listed.old_options.items():
            assert now in options
            assert old not in options
            for given, meant in (([old, "x"], [now, "x"]), ([f"{old}=x"], [f"{now}=x"])):
                assert present_options(listed, given)[0] == meant
            count += 1
    assert count > 0


def options_of(parser: ArgumentParser) -> Iterator[str]:
    """Options of a command and of its actions."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, _SubParsersAction):
            for subparser in action.choices.values():
                yield from options_of(subparser)


def test_the_command_line_of_core_names_no_command_of_a_plugin():
    names = set()
    for words, spec in specs().items():
        names |= {words, spec.name, *spec.old_names, *(old for old, _ in spec.old_options)}
    names -= {"run"}  # also a method of `CommandModule`
    for path in Path(roboneuron.cli.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        assert sorted(texts & names) == [], path.name
