"""`roboneuron plugins new KIND NAME` writes a package that passes its own contract tests, as
generated, for every kind.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from rn_testing.new import NEW_KINDS, PREFIXES, write_package
from roboneuron.cli.main import main
from roboneuron.errors import ConfigurationError


def install(project: Path, site: Path) -> None:
    """Make a project importable like an editable installation: its metadata and a path to its
    sources.

    Building wheels would need hatchling; RoboNeuron only reads the metadata.
    """
    facts = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    info = site / f"{facts['name'].replace('-', '_')}-{facts['version']}.dist-info"
    (info / "licenses").mkdir(parents=True)
    lines = [
        "Metadata-Version: 2.4",
        f"Name: {facts['name']}",
        f"Version: {facts['version']}",
        f"Summary: {facts['description']}",
        f"License-Expression: {facts['license']}",
        *(f"License-File: {name}" for name in facts["license-files"] if (project / name).is_file()),
        f"Requires-Python: {facts['requires-python']}",
        *(f"Requires-Dist: {requirement}" for requirement in facts["dependencies"]),
    ]
    (info / "METADATA").write_text(
        "\n".join(lines) + "\n\n" + (project / facts["readme"]).read_text()
    )
    for name in facts["license-files"]:
        (info / "licenses" / name).write_text((project / name).read_text())
    points = facts["entry-points"]["roboneuron"]
    (info / "entry_points.txt").write_text(
        "[roboneuron]\n" + "".join(f"{k} = {v}\n" for k, v in points.items())
    )


def run(words: list[str], project: Path, site: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(site), str(project / "src")])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, *words],
        cwd=project,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def made(kind, tmp_path):
    """A new project and its installation folder."""
    project, site = tmp_path / "project", tmp_path / "site"
    write_package(kind, "my-sample", project)
    install(project, site)
    return project, site


# needs a project, an installation and a pytest run for each
@pytest.mark.parametrize(
    "kind",
    [
        "backend",
        pytest.param("robot", marks=pytest.mark.exhaustive),
        *(
            pytest.param(kind, marks=pytest.mark.slow)
            for kind in NEW_KINDS
            if kind not in {"backend", "robot"}
        ),
    ],
)
def test_a_new_plugin_passes_its_own_tests(made):
    project, site = made
    tests = run(["-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error"], project, site)
    assert tests.returncode == 0, tests.stdout + tests.stderr
    counts = {
        word: int(count)
        for count, word in re.findall(r"(\d+) (passed|skipped|failed)", tests.stdout)
    }
    assert counts["passed"] > 15
    assert "failed" not in counts


# runs the same rules a second time
@pytest.mark.parametrize(
    "kind",
    [
        kind if kind == "backend" else pytest.param(kind, marks=pytest.mark.slow)
        for kind in NEW_KINDS
    ],
)
def test_a_new_plugin_passes_the_check(kind, made):
    project, site = made
    distribution = f"rn-{PREFIXES[kind]}-my-sample"
    check = run(
        ["-m", "roboneuron.cli.main", "plugins", "check", distribution, "--json"], project, site
    )
    results = json.loads(check.stdout)["results"]
    assert check.returncode == 0, [r for r in results if r["verdict"] == "failed"]
    assert {r["subject"] for r in results} == {distribution, f"{kind} my-sample"}


@pytest.mark.parametrize("kind", NEW_KINDS)
def test_a_new_plugin_is_complete_and_holds_no_placeholder(kind, tmp_path):
    written = write_package(kind, "a1-b2", tmp_path / "x")
    package = f"rn_{PREFIXES[kind]}_a1_b2"
    names = {str(path.relative_to(tmp_path / "x")) for path in written}
    assert names >= {
        "pyproject.toml",
        "README.md",
        "LICENSE",
        f"src/{package}/py.typed",
        f"src/{package}/plugin.py",
    }
    assert any(name.startswith("tests/test_") for name in names)
    assert not [p for p in written if p.name != "LICENSE" and "$" in p.read_text()]


def test_a_new_plugin_is_formatted_and_free_of_lint(tmp_path):
    for kind in NEW_KINDS:
        write_package(kind, "my-sample", tmp_path / kind)
    for words in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *words, "--no-cache", str(tmp_path)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout


def test_new_says_what_to_do_next(tmp_path, capsys):
    assert main(["plugins", "new", "backend", "my-policy", "--out", str(tmp_path / "p")]) == 0
    out = capsys.readouterr().out
    assert "rn-backend-my-policy" in out
    assert "roboneuron plugins check my-policy" in out


@pytest.mark.parametrize("name", ["My Policy", "a_b", "-x", "x-", "1st", "true", "../up"])
def test_new_refuses_names_that_cannot_be(name, tmp_path):
    with pytest.raises(ConfigurationError, match="is malformed"):
        write_package("backend", name, tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_new_never_writes_into_a_directory_that_holds_something(tmp_path, capsys):
    (tmp_path / "kept.txt").write_text("mine")
    assert main(["plugins", "new", "backend", "my-policy", "--out", str(tmp_path)]) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["kept.txt"]
