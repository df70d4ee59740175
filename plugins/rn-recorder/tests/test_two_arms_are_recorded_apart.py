"""Poses, joints, grippers and actions of two arms: told apart in a run, exported by name, and put
to a backend again as it saw them.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from rclpy.serialization import serialize_message

from rn_recorder.feature import _mounts
from rn_recorder_policy.asking import _ArmStates
from rn_recorder_policy.demonstration import STATE
from rn_recorder_policy.name_mapping import RecordedStates
from rn_recorder_policy.run_reading import read_run
from rn_recorder_runs.episodes import read_streams
from rn_recorder_runs.files import Record, RunFile
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.observations import Observations
from rn_recorder_runs.predictions import prediction_record
from rn_recorder_runs.store import Run
from roboneuron import (
    ActionChunk,
    ArmProfile,
    ArmState,
    CameraCalibration,
    CameraProfile,
    Frame,
    GripperProfile,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    robot_space,
)
from roboneuron.ros.messages import to_action_message, to_image, to_joint_state, to_pose_stamped

ROWS, PERIOD_NS, START_NS = 12, 100_000_000, 1_700_000_000_000_000_000
SIDES = ("left", "right")
ARMS = tuple(
    ArmProfile(
        name=side,
        joints=(f"{side}_j",),
        base_link="base",
        tcp_link=f"{side}_tcp",
        gripper=GripperProfile(joint=f"{side}_finger", closed_position=0.0, open_position=0.04),
    )
    for side in SIDES
)
CAMERA = CameraProfile(
    name="wrist",
    role="right_wrist",
    frame_id="wrist_optical",
    width=32,
    height=32,
    calibration=CameraCalibration(
        intrinsics=np.eye(3), mount="right/tcp", T_mount_camera=np.eye(4)
    ),
)
PAIR = RobotProfile(
    name="pair",
    base_link="base",
    tcp_link="left_tcp",
    arm_joints=("left_j", "right_j"),
    arms=ARMS,
    gripper=ARMS[0].gripper,
    cameras=(CAMERA,),
)
SPACE = robot_space("ee_pose", PAIR)
X_M = {"left": 0.2, "right": 0.8}


def pose(side: str, row: int) -> Pose:
    return Pose(
        position_m=np.array([X_M[side], 0.01 * row, 0.3]),
        quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        stamp_ns=START_NS + row * PERIOD_NS,
    )


def observation(row: int) -> Observation:
    at_ns = START_NS + row * PERIOD_NS
    image = np.full((32, 32, 3), 10 * row, dtype=np.uint8)
    return Observation(
        frames={
            "right_wrist": Frame(
                camera="wrist", image=image, stamp_ns=at_ns, frame_id="wrist_optical"
            )
        },
        instruction="hand it over",
        joints=JointSample(
            names=("left_j", "left_finger", "right_j", "right_finger"),
            position=np.array([0.1, 0.01, 0.2, 0.03]),
            stamp_ns=at_ns,
        ),
        ee_pose=pose("left", row),
        gripper_open=0.25,
        arms={
            side: ArmState(ee_pose=pose(side, row), gripper_open=opening)
            for side, opening in (("left", 0.25), ("right", 0.75))
        },
        stamp_ns=at_ns,
    )


def action(row: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    parts = [[*pose(s, row + 1).position_m, 0.0, 0.0, 0.0, 1.0, 0.5] for s in SIDES]
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    path = tmp_path_factory.mktemp("pair") / "part-0001.mcap"
    file = RunFile(path, {"robot": "pair", "contract": json.dumps({})})
    sequences: dict[str, int] = {}

    def send(topic: str, message: object, at_ns: int) -> None:
        sequences[topic] = sequences.get(topic, 0) + 1
        kind = type(message)
        name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
        data = bytes(serialize_message(message))
        file.write(Record(topic, name, at_ns, at_ns, sequences[topic], data))

    from std_msgs.msg import String

    for row in range(ROWS):
        seen, at_ns = observation(row), START_NS + row * PERIOD_NS
        assert seen.joints is not None
        send("/pair/camera/wrist/image", to_image(seen.frames["right_wrist"]), at_ns)
        send("/pair/joint_states", to_joint_state(seen.joints), at_ns)
        # the newest one counts, whichever arm it is of
        for topic, side in (("ee_pose", "left"), ("left/ee_pose", "left")):
            send(f"/pair/{topic}", to_pose_stamped(pose(side, row), "base"), at_ns)
        send("/pair/right/ee_pose", to_pose_stamped(pose("right", row), "base"), at_ns)
        chunk = ActionChunk(actions=action(row)[None, :], step_s=0.1, space=SPACE)
        send(
            "/pair/predictions",
            String(data=prediction_record(seen, "sequential", row == 0, chunk)),
            at_ns + 1,
        )
        send("/pair/action", to_action_message(action(row), SPACE), at_ns + 2)
    file.finish()
    return Run(id="pair", kind="recording", files=(path,), facts={})


def test_the_poses_of_two_arms_are_two_streams(run: Run) -> None:
    streams = read_streams(run.files)
    assert len(streams.poses) == ROWS
    for side in SIDES:
        assert {float(values[0]) for _, values in streams.arm_poses[side]} == {X_M[side]}
    assert {float(values[0]) for _, values in streams.poses} == {X_M["left"]}


def test_a_data_set_names_poses_grippers_and_actions_of_both(run: Run, tmp_path: Path) -> None:
    written = export([run], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert (written.episodes, written.frames, written.skipped) == (1, ROWS, ())
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    names = features["observation.ee_pose"]["names"]
    assert (names[0], names[7], len(names)) == ("left/x_m", "right/x_m", 14)
    assert "right_finger" in features["observation.state"]["names"]
    assert features["action"]["names"] == list(SPACE.keys)
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    poses = np.array(table.column("observation.ee_pose").to_pylist())
    np.testing.assert_allclose(poses[:, [0, 7]], [[0.2, 0.8]] * ROWS, atol=1e-6)
    np.testing.assert_array_equal(
        table.column("roboneuron.action").to_pylist(), [action(row) for row in range(ROWS)]
    )


def test_a_prediction_is_asked_again_with_the_state_of_both_arms(run: Run) -> None:
    again = Observations(run.files, {"right_wrist": CAMERA}, frozenset(), PAIR)
    seen = [observed for _, observed in again]
    assert len(seen) == ROWS
    for row, observed in enumerate(seen):
        for side in SIDES:
            asked = observation(row).arms[side]
            told = observed.arms[side]
            np.testing.assert_array_equal(told.ee_pose.position_m, asked.ee_pose.position_m)
            assert told.ee_pose.stamp_ns == asked.ee_pose.stamp_ns
            assert told.gripper_open == asked.gripper_open


def test_a_demonstration_tells_each_arm_by_its_name(run: Run) -> None:
    found = read_run(run.files, 0)
    column = found.columns["observation.ee_pose"]
    values = {str(name): column.values[:, place] for place, name in enumerate(column.names or ())}
    state = found.columns[STATE]
    values |= {str(name): state.values[:, place] for place, name in enumerate(state.names or ())}
    states = RecordedStates(values=values)
    at, opening = _ArmStates.of(ARMS[1], states).at(0, 5)
    assert at is not None
    assert (at.position_m[0], opening) == (pytest.approx(0.8), pytest.approx(0.75))
    at, opening = _ArmStates.of(ARMS[0], states).at(0, 5)
    assert at is not None
    assert (at.position_m[0], opening) == (pytest.approx(0.2), pytest.approx(0.25))


def test_the_camera_on_the_second_hand_is_mounted_there() -> None:
    (mount,) = _mounts(PAIR)
    assert (mount.parent, mount.frame_id) == ("right_tcp", "wrist_optical")
