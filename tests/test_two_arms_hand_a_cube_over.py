"""`make demo-pair`: the left FR3 hands a cube to the right one over ROS and MCP, and the simulator
confirms it to run_task.

Slow: 43 s on two cores. In the default lane servo, control and the judge hand a cube over in one
process (plugins/rn-backend-servo/tests/test_servo_hands_a_cube_over.py).
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

DEMO = Path(__file__).parents[1] / "examples" / "demo_pair.py"


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_left_arm_hands_a_cube_to_the_right_one(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    done = subprocess.run(
        [sys.executable, str(DEMO), "--seed", "3", "--output", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "'holders': ['right']" in done.stdout
    assert "succeeded: data of sim/handed_over" in done.stdout
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames > 10  # type: ignore[attr-defined]
