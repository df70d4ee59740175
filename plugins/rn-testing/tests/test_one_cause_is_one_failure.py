"""Problems of a whole case are reported once, and files in the working directory are not a plugin's
fault.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from rn_testing import PerceptionCase, RuleVerdict, fakes, verify
from rn_testing.rules import RULES

SPEC = replace(fakes.FAKE_PERCEPTION, config="mutants_descriptors:Demanding")


def test_a_case_without_a_required_option_fails_one_rule_that_says_what_to_write():
    outcomes = [verify(rule, PerceptionCase(spec=SPEC)) for rule in RULES["perception"]]
    [failed] = [outcome for outcome in outcomes if outcome.verdict is RuleVerdict.FAILED]
    assert failed.rule == "descriptor/case-options"
    assert failed.detail == (
        "Demanding requires topic, which the case does not set. Write "
        'PerceptionCase(spec=..., options={"topic": ...}) (topic: topic of the images)'
    )
    assert not any(outcome.traceback for outcome in outcomes)
    reasons = Counter(
        outcome.detail for outcome in outcomes if outcome.verdict is RuleVerdict.SKIPPED
    )
    assert reasons["the case lacks options, see descriptor/case-options"] > 10


def test_a_report_of_it_is_short(tmp_path):
    """As the author of a plugin sees it."""
    (tmp_path / "test_mine.py").write_text(
        """
import pytest
from dataclasses import replace
from rn_testing import PerceptionCase, PerceptionContract, fakes


class TestMine(PerceptionContract):
    @pytest.fixture
    def plugin(self):
        return PerceptionCase(spec=replace(fakes.FAKE_PERCEPTION, config="mutants_descriptors:Demanding"))
"""  # noqa: E501
    )
    path = os.pathsep.join(
        [str(Path(__file__).parent / "mutants"), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            "-q",
            "-c",
            os.devnull,
            "test_mine.py",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path, "PYTEST_ADDOPTS": ""},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "1 failed" in done.stdout, done.stdout + done.stderr
    assert len(done.stdout.splitlines()) < 20, done.stdout


@pytest.mark.exhaustive
def test_a_stray_file_in_the_working_directory_fails_no_rule(tmp_path):
    for name in ("re", "json", "dataclasses", "numpy", "socket"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('a stray file was imported')\n")
    script = Path(sys.executable).with_name("roboneuron")
    done = subprocess.run(
        [str(script), "plugins", "check", "rn-console", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.stdout, done.stderr
    results = json.loads(done.stdout)["results"]
    assert [r for r in results if r["verdict"] not in ("passed", "skipped")] == []
    assert sum(r["verdict"] == "passed" for r in results) > 50
