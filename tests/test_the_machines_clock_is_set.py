"""The machine's clock is changed in either direction while a cell moves: it continues by itself."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent / "clock"
HOUR_S, YEAR_S = 3600.0, 31_536_000.0
JUMPS_S = (HOUR_S, -HOUR_S, -YEAR_S, YEAR_S, -0.3, 30.0)


@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.timeout(300)
@pytest.mark.skipif(
    shutil.which("cc") is None, reason="needs a C compiler to stand in for a clock that is set"
)
def test_a_cell_goes_on_by_itself_when_the_clock_is_set(tmp_path: Path) -> None:
    shim, offset = tmp_path / "set_clock.so", tmp_path / "offset"
    subprocess.run(
        ["cc", "-O2", "-shared", "-fPIC", "-o", shim, HERE / "set_clock.c", "-ldl", "-lpthread"],
        check=True,
        timeout=60,
    )
    offset.write_bytes(bytes(8))
    done = subprocess.run(
        [sys.executable, HERE / "trial.py", tmp_path, *map(str, JUMPS_S)],
        env=os.environ | {"CLOCK_OFFSET_FILE": str(offset), "LD_PRELOAD": str(shim)},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    *told, switched, stopped = (
        json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")
    )
    assert [row["jump_s"] for row in told] == list(JUMPS_S)
    for row in told:
        assert abs(row["seen_s"] - row["jump_s"]) < 1.0, "the clock was set for this process"
        assert row["recovered_s"] is not None, row
        assert set(row["health"].values()) == {"ok"}, row
        assert row["largest_step_m"] < 0.005, "no jump of the arm"
        assert row["pids"] == told[0]["pids"], "nothing was ended or started again"
    assert switched == {"switched": True}
    assert stopped == {"stopped": [0, 0, 0, 0]}
