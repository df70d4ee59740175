"""lerobot's own commands with a simulated arm: two episodes, the data set, and a replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lerobot_lane import Lerobot, Watch, read_dataset, serve

TRACKED_DEG = 3.0
"""The arm follows a leader at 23 deg/s a tenth of a second late, and so do its measurements."""


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(420)
def test_what_was_recorded_is_opened_and_moves_the_arm_the_same_way(
    lerobot: Lerobot, config: Path, watch: Watch, tmp_path: Path
) -> None:
    folder = tmp_path / "data"
    lerobot.lead()
    robot = ("--robot.type=roboneuron", "--robot.robot=so101", serve(config))
    data = ("--dataset.repo_id=me/arm", f"--dataset.root={folder}")
    recording = lerobot.start(
        "lerobot-record",
        *robot,
        *data,
        "--teleop.type=roboneuron",
        "--teleop.robot=so101",
        "--dataset.single_task=sway",
        "--dataset.fps=15",
        "--dataset.num_episodes=2",
        "--dataset.episode_time_s=5",
        "--dataset.reset_time_s=0.5",
        "--dataset.push_to_hub=false",
        "--dataset.no_stamp=true",
        "--play_sounds=false",
    )
    assert recording.wait(240) == 0, lerobot.last_line(recording)

    found = read_dataset(folder, lerobot)
    action, state = np.array(found["action"]), np.array(found["state"])
    assert found["episodes"] == 2
    assert found["names"] == [
        *("shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos", "wrist_flex.pos"),
        *("wrist_roll.pos", "gripper.pos"),
    ]
    # an image of the table, not an empty one
    for shape, mean in found["images"].values():  # type: ignore[attr-defined]
        assert shape == [3, 224, 224]
        assert 0.2 < mean < 0.95
    # degrees and percent: a sway of 0.25 rad, an opening of 0.4 .. 1
    assert np.ptp(action[:, 0]) == pytest.approx(np.degrees(0.5), rel=0.05)
    assert action[:, 5].max() == pytest.approx(100.0, abs=2.0)
    assert action[:, 5].min() == pytest.approx(40.0, abs=4.0)
    assert np.abs(action - state)[:, :5].mean() < TRACKED_DEG

    watch.seen.clear()
    replaying = lerobot.start(
        "lerobot-replay", *robot, *data, "--dataset.episode=0", "--play_sounds=false"
    )
    assert replaying.wait(180) == 0, lerobot.last_line(replaying)
    first = action[np.array(found["episode"]) == 0][:, :5]
    # from home, about which the leader sways, by a jump to the first row and on to the end
    again = np.degrees(watch.since(0.0))
    np.testing.assert_allclose(again.max(axis=0), first.max(axis=0), atol=1.0)
    np.testing.assert_allclose(again.min(axis=0), first.min(axis=0), atol=1.0)
    assert "Traceback" not in lerobot.told(replaying).partition("torchcodec loading")[0]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize(("robot", "prefix"), [("fr3", ""), ("fr3-pair", "right_")])
def test_simulated_fr3s_are_teleoperated(
    lerobot: Lerobot, tmp_path: Path, robot: str, prefix: str
) -> None:
    config = tmp_path / "fr3.toml"
    config.write_text(
        f'[robot]\nname = "{robot}"\n[perception]\nsource = "{robot}-sim-camera"\n'
        '[control]\ncontroller = "urdf"\n',
        encoding="utf-8",
    )
    joints = tuple(f"{prefix}fr3_joint{i}" for i in range(1, 8))
    watch = Watch(robot.replace("-", "_"), joints)
    try:
        lerobot.lead(robot)
        teleoperating = lerobot.start(
            "lerobot-teleoperate",
            "--robot.type=roboneuron",
            f"--robot.robot={robot}",
            serve(config),
            "--teleop.type=roboneuron",
            f"--teleop.robot={robot}",
            "--fps=30",
            "--teleop_time_s=6",
        )
        assert teleoperating.wait(300) == 0, lerobot.last_line(teleoperating)
        moved = np.ptp(watch.since(0.0), axis=0)
    finally:
        watch.close()
    assert moved[0] == pytest.approx(0.5, abs=0.05)
    assert moved[4] == pytest.approx(0.6, abs=0.06)
