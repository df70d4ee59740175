"""Modules that are killed or frozen during each kind of motion, by benchmarks/lost_modules.py."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "lost_modules.py"


def results(folder: Path, cell: str, *options: str) -> list[dict[str, Any]]:
    """Run the trials; return what they found."""
    command = [sys.executable, BENCHMARK, "--cell", cell, "--folder", folder, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    ledger = folder / f"{cell}.jsonl"
    assert ledger.exists(), done.stdout + done.stderr
    return [json.loads(line) for line in ledger.read_text().splitlines()]


@pytest.mark.ros
@pytest.mark.timeout(150)
def test_a_frozen_policy_ends_a_task_by_its_name(tmp_path: Path) -> None:
    chosen = ("--motions", "run_task", "--ways", "frozen", "--modules", "inference")
    (found,) = results(tmp_path, "fr3", *chosen)
    # how soon it ends is judged where nothing runs beside it
    assert (found["problems"], found.get("hindered")) == ([], None), found


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(1300)
@pytest.mark.parametrize("cell", ["fr3", "pair", "fleet", "ros2"])
def test_every_lost_module_ends_every_motion_and_starts_none(cell: str, tmp_path: Path) -> None:
    found = results(tmp_path, cell)
    assert [one for one in found if one["problems"] or one.get("is_late")] == []
    assert sum("hindered" in one for one in found) < len(found) / 3
