"""Control's command for an action is returned to lerobot; a refused action does not move the
arm.
"""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from lerobot_lane import BIN, Lerobot, Served, Watch

HERE = Path(__file__).parent
STEP_DEG = 0.05
"""Motion of the simulated arm between reading and answer."""


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_answer_is_the_command_of_control(
    lerobot: Lerobot, served: Served, watch: Watch
) -> None:
    begun_s = time.monotonic()
    done = subprocess.run(
        [str(BIN / "python"), str(HERE / "send_check.py")],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
        env=lerobot.environment,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])

    small, jump = told["small"], told["jump"]
    for key, value in small["asked"].items():
        assert small["sent"][key] == pytest.approx(value, abs=STEP_DEG), key
    # a step of 40 degrees is refused: the answer is the arm's position
    assert jump["sent"]["shoulder_pan.pos"] == pytest.approx(
        jump["measured"]["shoulder_pan.pos"], abs=STEP_DEG
    )
    assert "The arm does not follow" in done.stderr
    moved = np.degrees(np.ptp(watch.since(begun_s)[:, 0]))
    assert moved == pytest.approx(1.0, abs=0.1)

    assert "'tail.pos' is no motor" in told["tail.pos"]
    assert "gripper.pos is 140, expected 0 .. 100" in told["gripper.pos"]
    assert "elbow_flex.pos is nan" in told["elbow_flex.pos"]
