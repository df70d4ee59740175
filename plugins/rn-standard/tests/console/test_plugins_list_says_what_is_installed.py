"""`roboneuron plugins list`: what it prints, its stable JSON, its exit status, and what it never
imports.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from rn_standard.console import plugins_list
from roboneuron.cli.main import main

SCHEMA = Path(__file__).parents[4] / "docs" / "reference" / "plugins-list.schema.json"

GOOD = """
@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="good", summary="Works.", target="good_module:Good",
                        requires=(Requirement(module="json", install="-"),), optional_cameras=("wrist",))]
"""  # noqa: E501


@pytest.fixture
def only(site, monkeypatch):
    """Makes the command see the plugins of the test's site and no others."""
    monkeypatch.setattr(plugins_list, "discover", site.discover)
    return site


LACKING = """
@hookimpl
def roboneuron_backends():
    needs = (Requirement(module="absent_library", install="pip install absent-library"),)
    return [BackendSpec(name="lacking", summary="Cannot.", target="m:C", requires=needs),
            BackendSpec(name="lacking-too", summary="Cannot.", target="m:C", requires=needs),
            BackendSpec(name="complete", summary="Can.", target="m:C")]
"""


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_the_short_list_fits_and_shows_what_is_missing(only, capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    only.install("rn-good", GOOD)
    only.install("rn-lacking", LACKING)
    assert main(["plugins", "list"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= columns
    assert len(out.splitlines()) < 40
    text = " ".join(out.split())
    assert "backend complete, good " in text
    assert "rn-lacking is unavailable" in text
    assert "backend lacking, backend lacking-too: Needs 'absent_library', not installed;" in text
    assert "run: pip install absent-library" in text
    assert "NOT INSTALLED" in text
    assert "rn-backend-openvla, rn-backend-pi0" in text


def test_the_short_list_of_everything_installed_fits_on_a_screen(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["plugins", "list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) <= 40


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_the_whole_list_shows_every_offer_and_what_to_do_about_trouble(
    only, capsys, monkeypatch, columns
):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("roboneuron.cli.main.apply_verbosity", lambda _: None)  # it would last
    only.install("rn-good", GOOD)
    only.install("rn-bad", "1 / 0")
    assert main(["plugins", "list", "--verbose"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= columns
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
    assert document["schema_version"] == plugins_list.SCHEMA_VERSION
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
        ("disabled_plugins = [", "not valid TOML"),
        ('disabled_plugins = ["rn-absent"]', "'rn-absent' is not installed"),
    ],
)
def test_a_wrong_configuration_is_named(only, tmp_path, capsys, text, words):
    config = tmp_path / "roboneuron.toml"
    config.write_text(text)
    assert main(["plugins", "--config", str(config), "list"]) == 2
    assert words in capsys.readouterr().err


def test_listing_everything_installed_imports_nothing_heavy():
    script = (
        "import sys; from roboneuron.cli.main import main; status = main(['plugins', 'list']);"
        "print([m for m in ('numpy','torch','rclpy','mcp','pydantic') if m in sys.modules], status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ},
    )
    assert done.stdout.strip().splitlines()[-1] == "[] 0"
