"""Recordings of the course, as the recorder writes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from policy_world import (
    FINGER,
    JOINTS,
    RATE_HZ,
    ROWS,
    SPACES,
    STATE_JOINTS,
    STATE_OPENINGS,
    STATE_POSES,
    picture,
    recorded,
)
from rclpy.serialization import serialize_message

from rn_recorder_runs.files import Record, RunFile
from rn_recorder_runs.images import to_string
from rn_recorder_runs.predictions import prediction_record
from roboneuron import ActionChunk, Frame, JointSample, Observation, Pose
from roboneuron.ros.messages import to_action_message, to_image, to_joint_state, to_pose_stamped

START_NS = 1_700_000_000_000_000_000


def observation(row: int) -> Observation:
    """What was seen and measured before a row."""
    at_ns = START_NS + round(row * 1e9 / RATE_HZ)
    return Observation(
        frames={
            "primary": Frame(
                camera="front", image=picture(row), stamp_ns=at_ns, frame_id="front_optical"
            )
        },
        instruction="pick up the cup",
        joints=JointSample(
            names=(*JOINTS, FINGER),
            position=np.append(STATE_JOINTS[row], 0.08 * STATE_OPENINGS[row]),
            stamp_ns=at_ns,
        ),
        ee_pose=Pose(
            position_m=STATE_POSES[row, :3], quaternion_xyzw=STATE_POSES[row, 3:], stamp_ns=at_ns
        ),
        gripper_open=float(STATE_OPENINGS[row]),
        stamp_ns=at_ns,
    )


def write_run(folder: Path, kind: str) -> Path:
    """A run with one episode of the course, actions in that space; a prediction for each."""
    folder.mkdir()
    space = SPACES[kind]
    file = RunFile(folder / "part-0001.mcap", {"robot": "toy", "contract": json.dumps({})})
    sequences: dict[str, int] = {}

    def add(topic: str, type_name: str, at_ns: int, data: bytes) -> None:
        sequences[topic] = sequences.get(topic, 0) + 1
        file.write(Record(topic, type_name, at_ns, at_ns, sequences[topic], data))

    def send(topic: str, message: object, at_ns: int) -> None:
        package = type(message).__module__.split(".")[0]
        name = f"{package}/msg/{type(message).__name__}"
        add(topic, name, at_ns, bytes(serialize_message(message)))

    for row, action in enumerate(recorded(kind)[:ROWS]):
        seen = observation(row)
        assert seen.joints is not None
        assert seen.ee_pose is not None
        at_ns = seen.stamp_ns
        send("/toy/camera/front/image", to_image(seen.frames["primary"]), at_ns)
        send("/toy/joint_states", to_joint_state(seen.joints), at_ns)
        send("/toy/ee_pose", to_pose_stamped(seen.ee_pose, "base"), at_ns)
        chunk = ActionChunk(actions=action[None, :], step_s=1.0 / RATE_HZ, space=space)
        text = prediction_record(seen, "sequential", row == 0, chunk)
        add("/toy/predictions", "std_msgs/msg/String", at_ns + 20_000_000, to_string(text))
        send("/toy/action", to_action_message(action, space), at_ns + 30_000_000)
    file.finish()
    return folder
