"""Some of the random sequences of benchmarks/new_starts.py: no stop, release, recovery or restart
starts motion.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(1300)]
BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "new_starts.py"
SEQUENCES = 4


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_no_sequence_moves_the_arm_without_a_new_start(engine: str, tmp_path: Path) -> None:
    pytest.importorskip(engine)
    command = [
        sys.executable,
        BENCHMARK,
        "--engine",
        engine,
        "--sequences",
        str(SEQUENCES),
        "--folder",
        tmp_path,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
    assert (tmp_path / f"{engine}.jsonl").exists(), done.stdout + done.stderr
    results = [json.loads(line) for line in (tmp_path / f"{engine}.jsonl").read_text().splitlines()]
    assert [result for result in results if result["problems"]] == []
    whole = [result for result in results if not result["hindered"]]
    assert len(whole) > SEQUENCES / 2, [result["hindered"] for result in results]
    assert sum(result["starts"] - result["idle"] for result in whole) > 0, (
        "the arm moved when it was asked to"
    )
