"""The lanes of the Makefile share the tests out: each runs in exactly one of them, and CI runs all
of those.
"""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LANES = ("test-units", "test-ros", "test-timing", "test-exhaustive-units", "test-exhaustive-ros")
HERE = ("ros", "timing", "exhaustive")
"""Markers that decide which of these lanes runs a test."""
ELSEWHERE = ("gpu", "hardware", "slow", "sourced", "peers", "release")
"""Markers of tests that none of them runs."""


@pytest.fixture(scope="module")
def expressions() -> dict[str, str]:
    """The marker expression of each lane, as make passes it on."""
    found = {}
    # a make that runs this test would pass its own options on
    environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    for lane in LANES:
        # with ARGS it looks for no files; the environment counts as set up
        shown = subprocess.run(
            ["make", "--dry-run", "--old-file=.venv/.develop", lane, "ARGS=file"],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        ).stdout
        (found[lane],) = re.findall(r'pytest .*-m "([a-z ]+)"', shown)
    return found


def is_taken(expression: str, markers: tuple[str, ...]) -> bool:
    """Whether a test with these markers fits; what pytest accepts, Python does too."""
    names = {name: name in markers for name in (*HERE, *ELSEWHERE)}
    return bool(eval(expression, {"__builtins__": {}}, names))


def test_every_marker_is_known_here() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    lines = tomllib.loads(text)["tool"]["pytest"]["ini_options"]["markers"]
    registered = {re.split(r"[:(]", line)[0] for line in lines}
    assert registered - {"sampled"} == {*HERE, *ELSEWHERE}


@pytest.mark.parametrize("size", range(len(HERE) + 1))
def test_a_test_is_in_exactly_one_lane(expressions: dict[str, str], size: int) -> None:
    for markers in itertools.combinations(HERE, size):
        lanes = [lane for lane in LANES if is_taken(expressions[lane], markers)]
        assert len(lanes) == 1, f"{markers}: {lanes}"
        for other in ELSEWHERE:
            lanes = [lane for lane in LANES if is_taken(expressions[lane], (*markers, other))]
            assert lanes == [], f"{(*markers, other)}: {lanes}"


def test_ci_runs_what_is_exhaustive_too() -> None:
    assert re.search(r"\nmake test\nmake test-exhaustive\n", (ROOT / ".ci" / "run").read_text())
    hosted = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    (matrix,) = re.findall(r"lane: \[(.*)\]", hosted)
    assert {"test-units", "test-ros", "test-timing", "test-exhaustive"} <= set(matrix.split(", "))


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("number", range(6))
def test_one_of_three_cases_is_not_exhaustive(request: pytest.FixtureRequest, number: int) -> None:
    is_exhaustive = request.node.get_closest_marker("exhaustive") is not None
    assert is_exhaustive == (number not in (0, 3))
