from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

LOOP = Path(__file__).parents[1] / "interop" / "loop.py"


# test_sglang_faults_hold_the_arm.py shows how the runtime fails and recovers
@pytest.mark.ros
@pytest.mark.slow
def test_the_closed_loop_is_served_loses_its_server_and_goes_on_in_process(tmp_path):
    """The scenario that `make interop-sglang` runs with real SGLang; about half a minute without
    it.
    """
    command = [sys.executable, str(LOOP), "--stand-in", "--watch-s", "2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=170, cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert not [line for line in lines if "FAIL" in line], done.stdout
    assert done.returncode == 0, done.stdout + done.stderr
    assert lines[-1] == "PASSED"
    assert sum("all topics and types are the same" in line for line in lines) == 2
