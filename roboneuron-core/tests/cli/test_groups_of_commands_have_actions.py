"""Commands in groups, such as `roboneuron plugins check`: their options, and errors about a missing
action.
"""

from __future__ import annotations

import pytest

from roboneuron.cli.main import main, named_command
from roboneuron.plugins.availability import install_command


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
    return [CommandSpec(name="plugins-check", summary="checks", target="rn_kit_plugin:Checker")]
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
        (["new", "backend", "nod"], "rn-testing"),
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
    assert named_command(["plugins", "--config", "list", "show", "x"]) == (
        "plugins-show",
        ["--config", "list", "x"],
    )
    assert named_command(["plugins", "-v", "list"]) == ("plugins-list", ["-v"])
    assert named_command(["serve", "--config", "list"]) == ("serve", ["--config", "list"])


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


def test_an_unknown_command_suggests_the_nearest(capsys):
    assert main(["plugin"]) == 2
    assert "Did you mean 'plugins'" in capsys.readouterr().err


def test_help_lists_every_command_without_importing_it(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "plugins list      list the installed plugins" in capsys.readouterr().out
