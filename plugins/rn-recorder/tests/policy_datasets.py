"""LeRobot data sets of the course, in the layouts v2.1 and v3.0, written without lerobot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
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

from rn_recorder_runs.episodes import POSE_NAMES
from rn_recorder_runs.video import CameraVideo

TASK = "pick up the cup"
BEFORE = 7
"""Rows of the episode before, in the same files of v3."""
CAMERA = "observation.images.front"


def columns(kind: str, unit: str) -> dict[str, np.ndarray]:
    """Numbers of the episode by feature."""
    actions = recorded(kind)
    joints = STATE_JOINTS
    if unit == "deg":
        actions = np.hstack([np.degrees(actions[:, :-1]), actions[:, -1:]])
        joints = np.degrees(joints)
    fingers = 0.08 * STATE_OPENINGS[:, None]
    return {
        "action": actions.astype(np.float32),
        "observation.state": np.hstack([joints, fingers]).astype(np.float32),
        "observation.ee_pose": STATE_POSES.astype(np.float32),
        "timestamp": (np.arange(ROWS) / RATE_HZ).astype(np.float32),
    }


def names(kind: str) -> dict[str, Sequence[str]]:
    """Names of the values by feature."""
    return {
        "action": SPACES[kind].keys,
        "observation.state": (*JOINTS, FINGER),
        "observation.ee_pose": POSE_NAMES,
    }


def write_dataset(
    path: Path, kind: str, *, version: str = "v3.0", unit: str = "rad", renamed: bool = False
) -> Path:
    """One episode of the course, in v3.0 the second one of its files.

    Args:
        path: folder.
        kind: of the space.
        version: "v2.1" or "v3.0".
        unit: of angles.
        renamed: names are "motor_0", ...
    """
    is_old = version == "v2.1"
    episode = 0 if is_old else 1
    before = 0 if is_old else BEFORE
    told = names(kind)
    if renamed:
        told = {key: [f"motor_{i}" for i in range(len(value))] for key, value in told.items()}
    features: dict[str, object] = {
        key: {
            "dtype": "float32",
            "shape": [len(value)],
            # v2.1 has them by group
            "names": {"motors": list(value)} if is_old else list(value),
        }
        for key, value in told.items()
    }
    features[CAMERA] = {"dtype": "video", "shape": [32, 32, 3], "names": ["h", "w", "c"]}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    folder = "chunk-{episode_chunk:03d}" if is_old else "chunk-{chunk_index:03d}"
    file = "episode_{episode_index:06d}" if is_old else "file-{file_index:03d}"
    video = f"{folder}/{{video_key}}" if is_old else f"{{video_key}}/{folder}"
    info = {
        "codebase_version": version,
        "fps": RATE_HZ,
        "features": features,
        "total_episodes": episode + 1,
        "chunks_size": 1000,
        "data_path": f"data/{folder}/{file}.parquet",
        "video_path": f"videos/{video}/{file}.mp4",
    }
    (path / "meta").mkdir(parents=True)
    (path / "meta/info.json").write_text(json.dumps(info))
    place = {"episode_chunk": 0, "episode_index": 0, "chunk_index": 0, "file_index": 0}
    data = {
        name: np.concatenate([values[:before] * 0.0, values])
        for name, values in columns(kind, unit).items()
    }
    data["episode_index"] = np.array([0] * before + [episode] * ROWS)
    table = pa.table({name: values.tolist() for name, values in data.items()})
    target = path / info["data_path"].format(**place)
    target.parent.mkdir(parents=True)
    pq.write_table(table, target)
    shown = CameraVideo(
        path / info["video_path"].format(video_key=CAMERA, **place), int(RATE_HZ), "h264"
    )
    for row in [ROWS - 1] * before + list(range(ROWS)):
        shown.add(picture(row), 1, 10)
    shown.close()
    if is_old:
        entry = {"episode_index": 0, "tasks": [TASK], "length": ROWS}
        (path / "meta/episodes.jsonl").write_text(json.dumps(entry) + "\n")
        return path
    entries = [
        {
            "episode_index": number,
            "tasks": [task],
            "length": rows,
            "data/chunk_index": 0,
            "data/file_index": 0,
            f"videos/{CAMERA}/chunk_index": 0,
            f"videos/{CAMERA}/file_index": 0,
            f"videos/{CAMERA}/from_timestamp": begin / RATE_HZ,
            "stats/action/mean": [0.0],
        }
        for number, (task, begin, rows) in enumerate((("wait", 0, before), (TASK, before, ROWS)))
    ]
    target = path / "meta/episodes/chunk-000/file-000.parquet"
    target.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(entries), target)
    return path
