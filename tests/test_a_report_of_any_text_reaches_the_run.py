"""A log line that pytest-xdist cannot send must not end the whole test run."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEST = """
import logging
def test_that_logs_half_a_surrogate_pair(record_property):
    logging.getLogger().warning("half \\ud800 of a pair")
    record_property("kept", object())
"""


@pytest.mark.exhaustive
def test_a_test_that_logs_half_a_surrogate_pair_passes_in_a_worker(tmp_path: Path) -> None:
    shutil.copy(ROOT / "conftest.py", tmp_path)
    (tmp_path / "test_log.py").write_text(TEST)
    command = [sys.executable, "-m", "pytest", "-n", "1", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout
