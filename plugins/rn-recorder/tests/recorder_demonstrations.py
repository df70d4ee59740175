"""Small recorded runs for tests: two cameras, joints, poses, predictions and actions of a made-up
arm.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message

from rn_recorder_runs.files import Record, RunFile, read_records, write_json
from rn_recorder_runs.images import to_string
from rn_recorder_runs.predictions import prediction_record
from rn_recorder_runs.store import RUN_FILE, Run, RunStore
from rn_standard.teleoperation.rows import Acting
from roboneuron import ActionChunk, Frame, JointSample, Observation, Pose
from roboneuron.ros.messages import to_action_message, to_image, to_joint_state, to_pose_stamped

PERIOD_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
CAMERAS = {"primary": "front", "wrist": "hand"}
JOINTS = ("shoulder", "elbow", "finger")


def picture(camera: str, number: int, size: int = 64) -> np.ndarray:
    """A smooth picture that differs from number to number, so that a wrong frame is seen behind any
    codec.
    """
    ramp = np.linspace(0, 120, size)
    level = (number * 37) % 130
    channels = [
        ramp[None, :] + level,
        ramp[:, None] + (20 if camera == "front" else 90),
        np.full((1, 1), level),
    ]
    return np.stack([np.broadcast_to(c, (size, size)) for c in channels], axis=-1).astype(np.uint8)


def observation(number: int, instruction: str, start_ns: int) -> Observation:
    """What the backend saw before action `number`."""
    stamp_ns = start_ns + number * PERIOD_NS
    return Observation(
        frames={
            role: Frame(
                camera=name,
                image=picture(name, number),
                stamp_ns=stamp_ns,
                frame_id=f"{name}_optical",
            )
            for role, name in CAMERAS.items()
        },
        instruction=instruction,
        joints=JointSample(
            names=JOINTS, position=np.array([0.1, 0.2, 0.01]) * number, stamp_ns=stamp_ns - 7
        ),
        ee_pose=Pose(
            position_m=np.array([0.5, 0.01 * number, 0.3]),
            quaternion_xyzw=np.array([0, 0, 0, 1.0]),
            stamp_ns=stamp_ns,
        ),
        gripper_open=0.5,
        stamp_ns=stamp_ns,
    )


def action(number: int) -> np.ndarray:
    """Action `number`: every bit of a float64 counts."""
    return np.array([np.pi / 1000 * number, -1 / 3000, 0.01, 1e-9 * number, 0.02, -0.03, 1 / 3])


def record_run(
    store: RunStore,
    name: str,
    instructions: list[tuple[str, str]],
    rows: int = 8,
    start_ns: int = 1_700_000_000_000_000_000,
    acting: Mapping[int, str | Acting] | None = None,
) -> Run:
    """A run of episodes (instruction, outcome), and its files in the store; `acting` says who moved
    the arm by which action, or all that control told of it.
    """
    folder = store.recordings / name
    folder.mkdir(parents=True)
    file = RunFile(
        folder / "part-0001.mcap", {"robot": "toy", "contract": json.dumps({"action": "m, rad"})}
    )
    sequences: dict[str, int] = {}

    def add(topic: str, type_name: str, at_ns: int, data: bytes) -> None:
        sequences[topic] = sequences.get(topic, 0) + 1
        file.write(Record(topic, type_name, at_ns, at_ns, sequences[topic], data))

    def send(topic: str, message: object, at_ns: int) -> None:
        package, kind = type(message).__module__.split(".")[:2]
        add(
            topic,
            f"{package}/{kind}/{type(message).__name__}",
            at_ns,
            bytes(serialize_message(message)),
        )

    number = 0
    for instruction, outcome in instructions:
        for row in range(rows):
            seen = observation(number, instruction, start_ns)
            for frame in seen.frames.values():
                send(f"/toy/camera/{frame.camera}/image", to_image(frame), frame.stamp_ns)
            assert seen.joints is not None
            assert seen.ee_pose is not None
            send("/toy/joint_states", to_joint_state(seen.joints), seen.stamp_ns)
            send("/toy/ee_pose", to_pose_stamped(seen.ee_pose, "base"), seen.stamp_ns)
            chunk = ActionChunk(actions=action(number)[None, :], step_s=0.1)
            text = prediction_record(seen, "sequential", row == 0, chunk)
            add(
                "/toy/predictions",
                "std_msgs/msg/String",
                seen.stamp_ns + 20_000_000,
                to_string(text),
            )
            send("/toy/action", to_action_message(action(number)), seen.stamp_ns + 30_000_000)
            if acting is not None and number in acting:
                told = acting[number]
                if isinstance(told, str):
                    told = Acting(who=told, session="one", number=number)
                send("/toy/acting", told.to_message(), seen.stamp_ns + 31_000_000)
            number += 1
        end = {
            "what": "episode_end",
            "at_ns": start_ns + number * PERIOD_NS - 1,
            "outcome": outcome,
        }
        add("/roboneuron/events", "std_msgs/msg/String", end["at_ns"], to_string(json.dumps(end)))  # type: ignore[arg-type]
    file.finish()
    write_json(folder / RUN_FILE, {"state": "finished"})
    return store.get(name)


def store_in(path: Path) -> RunStore:
    """A store below a test's directory."""
    store = RunStore(path / "runs")
    store.make()
    return store


def rewritten(run: Run, name: str, change: Callable[[Record], Record | None]) -> Run:
    """A run of the same messages but for what `change` makes of them; None loses one."""
    folder = run.files[0].parent.parent / name
    folder.mkdir()
    file = RunFile(folder / "part-0001.mcap", {"robot": "toy"})
    for record in read_records(run.files[0]):
        kept = change(record)
        if kept is not None:
            file.write(kept)
    file.finish()
    return Run(id=name, kind="recording", files=(folder / "part-0001.mcap",), facts={})
