"""tools/flakes.py runs test files again and again, and keeps the results."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "flakes.py"
CONFTEST = """
def pytest_addoption(parser):
    parser.addoption("--shuffle", type=int)
def pytest_configure(config):
    for name in ("not_marked",):
        config.addinivalue_line("markers", name)
"""
WAITING = """
import pathlib, time
runs = pathlib.Path(__file__).with_suffix(".runs")
def test_fails_every_second_time():
    runs.open("a").write("x")
    assert len(runs.read_text()) % 2, "even\\nodd"
def test_passes():
    pass
def test_is_skipped():
    import pytest
    pytest.skip("here")
"""
QUIET = "class TestIt:\n    def test_adds(self):\n        assert 1 + 1 == 2\n"
CRASHES = "import os, time\ndef test_ends_the_process():\n    os._exit(7)\n"
BROKEN = "import time\nimport nothing_of_this_name\n"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "tests").mkdir()
    (tmp_path / "conftest.py").write_text(CONFTEST)
    return tmp_path


def write(project: Path, **files: str) -> None:
    for name, text in files.items():
        (project / "tests" / f"test_{name}.py").write_text(text)


def flakes(project: Path, *arguments: str) -> tuple[int, str]:
    """Exit status and output."""
    command = [sys.executable, str(TOOL), "--root", str(project), "--workers", "1", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)
    return done.returncode, done.stdout + done.stderr


def rows(project: Path) -> list[dict[str, Any]]:
    ledger = project / "out" / "flakes" / "ledger.jsonl"
    return [json.loads(line) for line in ledger.read_text().splitlines()]


@pytest.mark.exhaustive
def test_a_test_that_fails_sometimes_is_counted_by_condition(project: Path) -> None:
    write(project, waiting=WAITING, quiet=QUIET)
    code, said = flakes(project, "--alone", "2", "--others", "1", "--busy", "0,1")
    assert code == 1
    name = "tests/test_waiting.py::test_fails_every_second_time"
    found = rows(project)
    assert [row["trial"]["files"] for row in found].count(["tests/test_quiet.py"]) == 1
    waiting = [row for row in found if row["trial"]["files"] == ["tests/test_waiting.py"]]
    assert [row["trial"]["number"] for row in waiting] == [0, 1]
    assert [row["trial"]["busy"] for row in waiting] == [0, 1]
    assert [list(row["failed"]) for row in waiting] == [[], [name]]
    assert [row["passed"] for row in waiting] == [2, 1]
    assert "1 of 2 runs failed" in said
    assert "busy=1 workers=1: 1 of 1" in said
    assert "1 x AssertionError: even" in said


@pytest.mark.exhaustive
def test_it_goes_on_where_it_was(project: Path) -> None:
    write(project, waiting=WAITING)
    assert flakes(project, "--alone", "1", "--busy", "0")[0] == 0
    code, _ = flakes(project, "--alone", "2", "--busy", "0")
    assert code == 1
    assert [row["trial"]["number"] for row in rows(project)] == [0, 1]
    with (project / "out" / "flakes" / "ledger.jsonl").open("a") as file:
        file.write('{"trial": {"files"')
    code, said = flakes(project, "--report")
    assert code == 1
    assert "ledger.jsonl:3 is left out" in said
    assert len((project / "tests" / "test_waiting.runs").read_text()) == 2


@pytest.mark.parametrize(
    ("text", "words"), [(CRASHES, "status 7"), (BROKEN, "nothing_of_this_name")]
)
def test_a_run_without_results_is_a_failure(project: Path, text: str, words: str) -> None:
    write(project, bad=text)
    code, said = flakes(project, "--alone", "1", "--busy", "0")
    assert code == 1
    assert words in said


def test_no_trial_begins_when_the_time_is_over(project: Path) -> None:
    write(project, waiting=WAITING)
    code, said = flakes(project, "--minutes", "0")
    assert code == 0
    assert "after 0 of" in said
    assert not (project / "out" / "flakes" / "ledger.jsonl").exists()
