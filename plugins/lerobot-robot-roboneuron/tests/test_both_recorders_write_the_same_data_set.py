"""One motion, recorded at the same time by `lerobot-record` and by rn-recorder: the data set
written by lerobot and the one exported by `roboneuron runs export --lerobot`, both opened by
lerobot.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from lerobot_lane import BIN, Lerobot, Served

from rn_recorder_runs.episodes import Streams, read_streams
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.reading import iterate
from rn_recorder_runs.store import Run, RunStore
from rn_robot_lerobot.profile import so101_profile
from rn_robot_lerobot.units import MotorMap, motors_of

HERE = Path(__file__).parent
FPS, EPISODE_S, SIDE_PX = 10, 5, 96
FRAME_NS = 1_000_000_000 // FPS
ROUNDING = 2e-4
"""float32 in degrees and percent, and in radians: 1.5e-5 of 200."""
CODEC = 6.0
"""Mean difference of a frame, of 255, that the two codecs may cause together."""
SAME_SHARE = 0.9
"""Fraction of lerobot's rows whose action is a command that control has sent, and whose state is a
recorded message. A busy machine loses or delays a message now and then.
"""
MISSED_ROWS = 3
"""Rows that lerobot sends before the recorder has discovered it; measured: one."""
CAMERAS = ("front", "wrist")
SECTIONS = f"""
[recorder]
images = "lossless"

[plugins.so101-sim-camera]
width = {SIDE_PX}
height = {SIDE_PX}
"""


@pytest.fixture
def config(config: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Configuration with small images, and a recorder that stores each of them unchanged."""
    monkeypatch.delenv("ROBONEURON_RECORDER", raising=False)
    config.write_text(config.read_text(encoding="utf-8") + SECTIONS, encoding="utf-8")
    return config


def arrays_of(folder: Path, lerobot: Lerobot) -> dict[str, np.ndarray]:
    """A data set as read by lerobot."""
    target = folder.with_suffix(".npz")
    done = subprocess.run(
        [str(BIN / "python"), str(HERE / "dataset_arrays.py"), str(folder), str(target)],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
        env=lerobot.environment,
    )
    assert done.returncode == 0, done.stderr
    with np.load(target) as file:
        return dict(file)


def in_motor_units(values: np.ndarray, names: np.ndarray, motors: MotorMap) -> np.ndarray:
    """Convert rows (n, m) [rad, opening] by name to lerobot's [degrees, percent]."""
    gripper = so101_profile().gripper
    assert gripper is not None
    columns = {str(name): values[:, number] for number, name in enumerate(names)}
    if "gripper_open" in columns:
        columns[gripper.joint] = np.array([gripper.to_position(o) for o in columns["gripper_open"]])
    rows = [
        motors.values({joint: columns[joint][number] for joint in motors.joints})
        for number in range(len(values))
    ]
    return np.array([[row[key] for key in motors.keys] for row in rows])


def measured_about(streams: Streams, sent_ns: int, motors: MotorMap) -> np.ndarray:
    """Joint states (n, m) within a frame of an action, in motor units."""
    recent = [
        motors.values(dict(zip(streams.joint_names, position.tolist(), strict=True)))
        for at_ns, position in streams.joints
        if abs(at_ns - sent_ns) <= FRAME_NS
    ]
    return np.array([[row[key] for key in motors.keys] for row in recent])


def commanded_after(times_ns: list[int], run: Run, motors: MotorMap) -> np.ndarray:
    """The commands (n, m) that control computed from actions sent at these times, in motor
    units.
    """
    commands = [
        (
            entry.record.log_ns,
            dict(zip(entry.message.joint_names, points[-1].positions, strict=True)),
        )
        for entry in iterate(run.files, lambda topic: topic.endswith("/joint_trajectory"))
        if (points := entry.message.points)
    ]
    answers = [
        next(command for at_ns, command in commands if at_ns >= sent_ns) for sent_ns in times_ns
    ]
    rows = [motors.values({**dict.fromkeys(motors.joints, np.nan), **row}) for row in answers]
    return np.array([[row[key] for key in motors.keys] for row in rows])


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(500)
def test_they_are_equal_within_rounding_and_a_frame(
    lerobot: Lerobot, served: Served, tmp_path: Path
) -> None:
    theirs_in, ours_in = tmp_path / "theirs", tmp_path / "ours"
    lerobot.lead()
    begun = served.call("start_recording", name="both", note="sway")
    recording = lerobot.start(
        "lerobot-record",
        "--robot.type=roboneuron",
        "--robot.robot=so101",
        f"--robot.width={SIDE_PX}",
        f"--robot.height={SIDE_PX}",
        "--teleop.type=roboneuron",
        "--teleop.robot=so101",
        "--dataset.repo_id=local/arm",
        f"--dataset.root={theirs_in}",
        "--dataset.single_task=sway",
        f"--dataset.fps={FPS}",
        "--dataset.num_episodes=1",
        f"--dataset.episode_time_s={EPISODE_S}",
        "--dataset.push_to_hub=false",
        "--dataset.no_stamp=true",
        "--play_sounds=false",
    )
    assert recording.wait(300) == 0, lerobot.last_line(recording)
    served.call("stop_recording", outcome="success")
    run = RunStore(Path(str(begun["directory"])).parents[1]).get(str(begun["id"]))
    export([run], ours_in, outcome="success", fps=None, codec="h264")
    compare(arrays_of(theirs_in, lerobot), arrays_of(ours_in, lerobot), run)


def compare(theirs: dict[str, np.ndarray], ours: dict[str, np.ndarray], run: Run) -> None:
    """Raise AssertionError if the two differ by more than the tolerances above."""
    motors, streams = motors_of(so101_profile()), read_streams(run.files)
    assert int(theirs["episodes"]) == int(ours["episodes"]) == 1
    assert int(theirs["fps"]) == int(ours["fps"]) == FPS
    missed = len(theirs["action"]) - len(ours["action"])
    assert 0 <= missed <= MISSED_ROWS
    assert len(ours["action"]) > 0.8 * FPS * EPISODE_S
    counted = [key for key, rows in theirs.items() if rows.ndim and not key.endswith(".names")]
    theirs = theirs | {key: theirs[key][missed:] for key in counted}
    began_s = theirs["timestamp"][0]
    np.testing.assert_allclose(theirs["timestamp"] - began_s, ours["timestamp"], atol=1e-5)

    action, state = (
        in_motor_units(ours[key], ours[f"{key}.names"], motors)
        for key in ("action", "observation.state")
    )
    assert np.ptp(action[:, 0]) > 20.0  # it has moved
    np.testing.assert_allclose(theirs["action"], action, atol=ROUNDING)
    sent = commanded_after([action.sent_ns for action in streams.actions], run, motors)
    as_sent = np.abs(sent - theirs["action"]).max(axis=1) < ROUNDING
    assert as_sent.mean() > SAME_SHARE, as_sent

    # lerobot reads the joints some milliseconds before the action is sent, we take those before it
    frame = np.abs(np.diff(state, axis=0)).max(axis=0)
    apart = np.abs(theirs["observation.state"] - state)
    assert (apart <= frame + ROUNDING).all(), apart.max(axis=0)
    nearest = np.array(
        [
            np.abs(measured_about(streams, row.sent_ns, motors) - state).max(axis=1).min()
            for row, state in zip(streams.actions, theirs["observation.state"], strict=True)
        ]
    )
    assert (nearest < ROUNDING).mean() > SAME_SHARE, nearest

    for camera in CAMERAS:
        shown, kept = (found[f"observation.images.{camera}"] for found in (theirs, ours))
        assert shown.shape == kept.shape == (len(action), 3, SIDE_PX, SIDE_PX)
        for number, image in enumerate(shown):
            within = kept[max(0, number - 1) : number + 2]
            error = np.abs(within - image).mean(axis=(1, 2, 3)).min()
            assert error < CODEC, (camera, number, error)
