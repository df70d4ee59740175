"""Commands in groups, such as `roboneuron plugins check`: their options, errors about a missing
action, and those that a plugin adds to a group.
"""

from __future__ import annotations

import pytest

from roboneuron.cli.listing import all_commands
from roboneuron.cli.main import main, split_action
from roboneuron.plugins.availability import install_command
from roboneuron.plugins.discovery import discover

MOST_COMMANDS = 22
"""Words after `roboneuron` that a user meets first."""


@pytest.fixture
def only(site, monkeypatch):
    """Make the command line see only the plugins of the test's site."""
    monkeypatch.setattr("roboneuron.cli.main.discover", site.discover)
    return site


CHECKER = """
class Checker:
    \"\"\"Check.\"\"\"
    def configure(self, parser):
        parser.add_argument("--config")
        parser.add_argument("name")
        parser.add_argument("--json", action="store_true")
    def run(self, arguments):
        print("checked", arguments.name, arguments.json, arguments.config)
        return 1

@hookimpl
def roboneuron_commands():
    return [
        CommandSpec(
            name="plugins-check", group="plugins", summary="checks", target="rn_kit_plugin:Checker"
        )
    ]
"""


def test_check_hands_its_words_over_to_the_command_of_a_plugin(only, tmp_path, capsys):
    only.install("rn-kit", CHECKER)
    config = tmp_path / "roboneuron.toml"
    config.write_text("disabled_plugins = []\n")
    assert main(["plugins", "--config", str(config), "check", "--json", "rn-kit"]) == 1
    assert capsys.readouterr().out == f"checked rn-kit True {config}\n"
    with pytest.raises(SystemExit):
        main(["plugins", "check", "--help"])
    assert "usage: roboneuron plugins check [-h]" in capsys.readouterr().out


def test_check_without_such_a_plugin_says_what_to_install(only, capsys):
    assert main(["plugins", "check", "rn-kit"]) == 2
    error = capsys.readouterr().err
    assert "the package rn-testing brings it" in error
    assert "pip install -r requirements.txt ./plugins/rn-testing" in error


@pytest.mark.parametrize(
    ("words", "package"),
    [
        (["plugins", "new", "backend", "nod"], "rn-testing"),
        (["call", "get_status"], "rn-standard"),
        (["tools"], "rn-standard"),
        (["config", "show"], "rn-standard"),
        (["config", "reference"], "rn-standard"),
        (["config", "check", "x.toml"], "rn-standard"),
        (["plugins", "list"], "rn-standard"),
        (["plugins", "show", "fr3"], "rn-standard"),
    ],
)
def test_a_command_that_is_not_installed_is_named_with_its_package(only, capsys, words, package):
    assert main(words) == 2
    assert f"the package {package} brings it" in capsys.readouterr().err


def test_options_of_a_group_may_stand_before_its_action():
    assert split_action(["--config", "list", "show", "x"]) == ("show", ["--config", "list", "x"])
    assert split_action(["-v", "list"]) == ("list", ["-v"])
    assert split_action(["--help"]) == ("", ["--help"])


@pytest.mark.parametrize("words", [["plugins"], ["plugins", "--help"]])
def test_a_group_without_an_action_lists_its_actions(only, capsys, words):
    only.install("rn-kit", CHECKER)
    try:
        status = main(words)
    except SystemExit as ended:
        status = 0 if ended.code == 0 else 1
    assert status == (0 if "--help" in words else 2)
    shown = "".join(capsys.readouterr())
    assert "plugins check  checks" in shown
    assert "serve" not in shown


@pytest.mark.parametrize(
    ("group", "packages"), [("config", ["rn-standard"]), ("plugins", ["rn-standard", "rn-testing"])]
)
@pytest.mark.parametrize("options", [[], ["--help"]])
def test_a_group_without_any_installed_action_says_what_to_install(
    only, capsys, group, packages, options
):
    assert main([group, *options]) == 2
    assert install_command(*packages) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "meant"),
    [(["plugin"], "plugins"), (["plugins", "lst"], "plugins list"), (["doctr"], "doctor")],
)
def test_an_unknown_command_suggests_the_nearest(capsys, words, meant):
    assert main(words) == 2
    assert f"Did you mean {meant!r}" in capsys.readouterr().err


OWN = """
class Store:
    \"\"\"Keep parts.\"\"\"
    def configure(self, parser):
        actions = parser.add_subparsers(dest="action", required=True)
        actions.add_parser("list", help="what is kept")
    def run(self, arguments):
        print("store", arguments.action)
        return 0

@hookimpl
def roboneuron_commands():
    return [
        CommandSpec(name="store", summary="keep parts", target="rn_store_plugin:Store")
    ]
"""
ADDED = """
class Added:
    \"\"\"Add.\"\"\"
    def configure(self, parser):
        parser.add_argument("--twice", action="store_true")
    def run(self, arguments):
        print("added", arguments.twice)
        return 0

def offered(name, group):
    return CommandSpec(name=name, group=group, summary="adds", target="rn_other_plugin:Added")

@hookimpl
def roboneuron_commands():
    return [
        offered("store-push", "store"),
        offered("store-list", "store"),
        offered("robot-polish", "robot"),
        offered("painting-mix", "painting"),
    ]
"""


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        ("store list", "store list"),  # a command keeps its own actions
        ("store push --twice", "added True"),
        ("robot polish", "added False"),
        ("painting mix --twice", "added True"),
    ],
)
def test_a_plugin_adds_a_command_to_any_group(only, capsys, words, printed):
    only.install("rn-store", OWN)
    only.install("rn-other", ADDED)
    assert main(words.split()) == 0
    assert capsys.readouterr().out == f"{printed}\n"


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("--help", "painting  mix"),
        ("--help", "store     keep parts"),
        ("painting --help", "painting mix  adds"),
        ("store --help", "push         adds"),
    ],
)
def test_help_shows_what_a_plugin_adds_to_groups(only, capsys, words, shown):
    only.install("rn-store", OWN)
    only.install("rn-other", ADDED)
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 0
    assert shown in capsys.readouterr().out


@pytest.mark.parametrize(
    "fields",
    [
        'name="push", group="store"',
        'name="store-push", group="Store"',
        'name="push", section="first"',
        'name="store-push", group="store", section="start"',
    ],
)
def test_a_command_with_a_wrong_place_is_refused(only, fields):
    text = f'CommandSpec({fields}, summary="s", target="rn_kit_plugin:Checker")'
    only.install("rn-kit", CHECKER.replace(CHECKER[CHECKER.index("CommandSpec(") :], f"{text}]\n"))
    [record] = only.discover().plugins
    assert record.status == "failed"


def test_the_first_help_is_short(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    commands = {c.words.split()[0] for c in all_commands(discover())}
    rows = [line for line in shown.splitlines() if line[:2] == "  " and line[2:3].isalpha()]
    assert {row.split()[0] for row in rows} == commands
    assert len(rows) == len(commands) <= MOST_COMMANDS
