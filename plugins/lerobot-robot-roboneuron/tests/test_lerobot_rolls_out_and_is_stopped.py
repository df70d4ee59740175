"""lerobot's own policy loop moves our arm; and an emergency stop while lerobot records."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from lerobot_lane import BIN, PATIENT, ROOT, Lerobot, Served, Watch, read_dataset, release_stop

from rn_robot_lerobot.arm import SO101
from rn_testing.waiting import wait_until

ACTION_TIMEOUT_S, BRAKING_S = 0.5, 0.3
"""Control's timeout; the simulated arm's braking time on a busy machine."""
END_S = 200.0
TURN_DEG = 8.0
"""Position of the tiny policy's data relative to the arm's home."""
pytestmark = [pytest.mark.ros, pytest.mark.slow]
MAKE = """
import sys
from pathlib import Path
from rn_backend_lerobot.tiny import make_tiny
from rn_backend_lerobot.tiny_checkpoint import TinyShape
means = tuple(float(value) for value in sys.argv[2].split(","))
make_tiny(Path(sys.argv[1]), "act", TinyShape(width=224, height=224, means=means))
"""


@pytest.fixture
def policy(lerobot: Lerobot, tmp_path: Path) -> Path:
    """A tiny random ACT for an SO-101 that turns its first joint."""
    folder = tmp_path / "policy"
    means = [*np.degrees(SO101.home_rad), 50.0]
    means[0] += TURN_DEG
    sources = [ROOT / "plugins" / name / "src" for name in ("rn-backend-lerobot", "rn-vla")]
    subprocess.run(
        [str(BIN / "python"), "-c", MAKE, str(folder), ",".join(map(str, means))],
        env={**lerobot.environment, "PYTHONPATH": os.pathsep.join(map(str, sources))},
        check=True,
        timeout=180,
    )
    return folder


@pytest.mark.timeout(600)
def test_lerobots_rollout_moves_the_arm_with_a_policy(
    lerobot: Lerobot, policy: Path, served: Served, watch: Watch
) -> None:
    begun_s = time.monotonic()
    process = lerobot.start(
        "lerobot-rollout",
        f"--policy.path={policy}",
        "--robot.type=roboneuron",
        "--robot.robot=so101",
        *PATIENT,
        "--task=sway",
        "--fps=10",
        "--duration=6",
        "--device=cpu",
        "--play_sounds=false",
    )
    assert process.wait(END_S) == 0, lerobot.last_line(process)
    pan = np.degrees(watch.since(begun_s)[:, 0])
    home = np.degrees(SO101.home_rad[0])
    # random weights add a small part of the data's spread, which is 0.05 degrees
    assert pan.max() == pytest.approx(home + TURN_DEG, abs=0.5)
    # lerobot's last action: back to the start
    assert pan[-1] == pytest.approx(home, abs=1.0)
    others = np.degrees(np.ptp(watch.since(begun_s)[:, 1:], axis=0))
    assert others.max() < 1.0


@pytest.mark.timeout(900)
def test_a_stop_while_lerobot_records_leaves_an_arm_at_rest_and_a_data_set_to_read(
    lerobot: Lerobot, served: Served, watch: Watch, tmp_path: Path
) -> None:
    folder = tmp_path / "data"
    lerobot.lead()
    recording = record(lerobot, folder)
    wait_until(
        lambda: "Recording episode 1" in lerobot.told(recording) or recording.poll() is not None,
        END_S,
        "the second episode",
    )
    assert recording.poll() is None, lerobot.last_line(recording)
    wait_until(watch.is_moving, 20.0, "the arm to be led")
    begun_s = time.monotonic()
    served.call("emergency_stop")
    after_s = watch.rest_after_s(begun_s)
    print(f"at rest {after_s:.2f} s after the emergency stop")
    assert after_s < ACTION_TIMEOUT_S + BRAKING_S
    assert recording.wait(END_S) != 0
    assert "The emergency stop was triggered: the arm holds" in lerobot.last_line(recording)

    found = read_dataset(folder, lerobot)
    assert found["episodes"] == 1
    action = np.array(found["action"])
    assert np.ptp(action[:, 0]) > 10.0

    release_stop(tmp_path / "state" / "roboneuron")
    released_s = time.monotonic()
    again = record(lerobot, folder, "--resume=true")
    assert again.wait(END_S) != 0
    assert "Motion needs a new start after a stop" in lerobot.last_line(again)
    assert watch.rest_after_s(released_s) == 0.0
    served.call("move_joints", positions={"shoulder_pan": 0.0})
    last = record(lerobot, folder, "--resume=true", "--dataset.num_episodes=1")
    assert last.wait(END_S) == 0, lerobot.last_line(last)
    assert read_dataset(folder, lerobot)["episodes"] == 2


def record(lerobot: Lerobot, folder: Path, *options: str) -> subprocess.Popen[str]:
    return lerobot.start(
        "lerobot-record",
        "--robot.type=roboneuron",
        "--robot.robot=so101",
        "--teleop.type=roboneuron",
        "--teleop.robot=so101",
        "--teleop.timeout_s=3",
        *PATIENT,
        "--dataset.repo_id=me/arm",
        f"--dataset.root={folder}",
        "--dataset.single_task=sway",
        "--dataset.fps=10",
        "--dataset.num_episodes=3",
        "--dataset.episode_time_s=4",
        "--dataset.reset_time_s=0.5",
        "--dataset.push_to_hub=false",
        "--dataset.no_stamp=true",
        "--play_sounds=false",
        *options,
    )
