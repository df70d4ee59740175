"""Commands of plugins are listed and run like core's own; a broken one reports its error in one
line.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from roboneuron.cli import main
from roboneuron.plugins.registry import Registry

PLUGIN = """
from roboneuron import CommandSpec, hookimpl

@hookimpl
def roboneuron_commands():
    return [
        CommandSpec(name="greet", summary="greet somebody", target="rn_greeting.command:Greet"),
        CommandSpec(name="broken", summary="never works", target="rn_greeting.command:Missing"),
        CommandSpec(name="serve", summary="would hide core's own", target="rn_greeting.command:Greet"),
    ]
"""  # noqa: E501
COMMAND = '''
class Greet:
    """Greet somebody."""

    def configure(self, parser):
        parser.add_argument("--who", default="robot", help="who")

    def run(self, arguments):
        print("Hello,", arguments.who)
        return 3
'''


@pytest.fixture
def run(tmp_path: Path):
    package = tmp_path / "rn_greeting"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "plugin.py").write_text(PLUGIN)
    (package / "command.py").write_text(COMMAND)
    info = tmp_path / "rn_greeting-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rn-greeting\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-greeting = rn_greeting.plugin\n")

    def command(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "roboneuron.cli.main", *words],
            env={"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin"},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    return command


def test_a_plugins_command_is_listed_helped_and_run(run):
    assert re.search(r"^  greet +greet somebody$", run("--help").stdout, flags=re.MULTILINE)
    assert "Greet somebody." in run("greet", "--help").stdout
    done = run("greet", "--who", "arm")
    assert (done.returncode, done.stdout) == (3, "Hello, arm\n")


def test_a_command_that_cannot_be_loaded_says_why_in_one_line(run):
    done = run("broken")
    assert done.returncode == 2
    assert "no attribute 'Missing'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_core_keeps_its_own_commands_and_suggests_the_nearest(run):
    assert "serve MCP tools" in run("--help").stdout
    assert "would hide" not in run("--help").stdout
    assert "Did you mean 'greet'?" in run("gret").stderr


def test_a_command_of_a_package_that_is_not_installed_names_it(monkeypatch, capsys):
    monkeypatch.setattr(main, "discover", lambda: Registry(plugins=(), all_offers=()))
    assert main.main(["doctor"]) == 2
    said = capsys.readouterr().err
    assert "the package rn-standard brings it" in said
    assert "pip install -r requirements.txt" in said
