"""`roboneuron plugins list`: what it prints, its stable JSON, its exit status, and what it never imports."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from roboneuron.cli import plugins
from roboneuron.cli.commands import named_command
from roboneuron.cli.main import main
from roboneuron.plugins.discovery import discover_from

SCHEMA = Path(__file__).parents[3] / "docs" / "reference" / "plugins-list.schema.json"

GOOD = """
@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="good", summary="Works.", target="good_module:Good",
                        requires=(Requirement(module="json", install="-"),), optional_cameras=("wrist",))]
"""


@pytest.fixture
def only(site, monkeypatch):
    """Makes the commands see the plugins of the test's site and no others."""

    def discover(disabled=()):
        from importlib.metadata import distributions

        points = [p for d in distributions(path=[str(site.path)]) for p in d.entry_points if p.group == "roboneuron"]
        return discover_from(points, disabled)

    monkeypatch.setattr("roboneuron.cli.plugins.discover", discover)
    monkeypatch.setattr("roboneuron.cli.main.discover", discover)
    return site


def test_list_shows_every_offer_and_what_to_do_about_trouble(only, capsys):
    only.install("rn-good", GOOD)
    only.install("rn-bad", "1 / 0")
    assert main(["plugins", "list"]) == 0
    out = capsys.readouterr().out
    assert "good" in out
    assert "Works." in out
    assert "rn-bad is failed" in out
    assert "ZeroDivisionError" in out
    assert "roboneuron plugins show rn-bad" in out
    assert "\x1b" not in out


def test_list_without_plugins_says_what_to_install(only, capsys):
    assert main(["plugins", "list"]) == 0
    assert "pip install" in capsys.readouterr().out


def test_list_json_follows_its_schema(only, capsys):
    only.install("rn-good", GOOD)
    only.install("rn-bad", "1 / 0")
    only.install("rn-off", GOOD)
    assert main(["plugins", "list", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    jsonschema.validate(document, json.loads(SCHEMA.read_text()))
    assert document["schema_version"] == plugins.SCHEMA_VERSION
    assert [p["status"] for p in document["plugins"]] == ["failed", "conflict", "conflict"]
    assert document["plugins"][1]["offers"][0]["requires"] == ["json"]


def test_list_strict_fails_for_trouble_and_not_for_what_is_disabled(only, tmp_path, capsys):
    only.install("rn-good", GOOD)
    assert main(["plugins", "list", "--strict"]) == 0
    only.install("rn-bad", "1 / 0")
    assert main(["plugins", "list", "--strict"]) == 1
    config = tmp_path / "roboneuron.toml"
    config.write_text('disabled_plugins = ["rn-bad"]\n')
    assert main(["plugins", "--config", str(config), "list", "--strict"]) == 0
    assert "disabled" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('disabled_plugins = "rn-bad"', "expected a list"),
        ("disabled_plugins = [", "no valid TOML"),
        ('disabled_plugins = ["rn-absent"]', "'rn-absent' is not installed"),
    ],
)
def test_a_wrong_configuration_is_named(only, tmp_path, capsys, text, words):
    config = tmp_path / "roboneuron.toml"
    config.write_text(text)
    assert main(["plugins", "--config", str(config), "list"]) == 2
    assert words in capsys.readouterr().err


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
    assert "pip install ./plugins/rn-testing" in error


@pytest.mark.parametrize(
    ("words", "package"),
    [
        (["new", "backend", "nod"], "rn-testing"),
        (["call", "get_status"], "rn-console"),
        (["tools"], "rn-console"),
        (["config", "show"], "rn-console"),
        (["config", "reference"], "rn-console"),
        (["plugins", "show", "fr3"], "rn-console"),
    ],
)
def test_a_command_that_is_not_installed_is_named_with_its_package(only, capsys, words, package):
    assert main(words) == 2
    assert f"the package {package} brings it" in capsys.readouterr().err


def test_options_of_a_group_may_stand_before_its_action():
    assert named_command(["plugins", "--config", "list", "show", "x"]) == ("plugins-show", ["--config", "list", "x"])
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
    assert "plugins list" in shown
    assert "plugins check  checks" in shown
    assert "serve" not in shown


def test_listing_everything_installed_imports_nothing_heavy():
    script = (
        "import sys; from roboneuron.cli.main import main; status = main(['plugins', 'list']);"
        "print([m for m in ('numpy','torch','rclpy','mcp','pydantic') if m in sys.modules], status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env={**os.environ}
    )
    assert done.stdout.strip().splitlines()[-1] == "[] 0"


def test_an_unknown_command_suggests_the_nearest(capsys):
    assert main(["plugin"]) == 2
    assert "did you mean 'plugins'" in capsys.readouterr().err


def test_help_lists_every_command_without_importing_it(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "plugins list      list the installed plugins" in capsys.readouterr().out
