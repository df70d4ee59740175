"""Metadata of a LeRobotDataset v3: features, tasks, info, and the origin of the episodes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, cast

import numpy as np

from rn_recorder_runs.acted import WHO
from rn_recorder_runs.episodes import RecordedEpisode
from rn_recorder_runs.files import read_about
from rn_recorder_runs.store import Run
from rn_recorder_runs.video import Codec
from roboneuron import (
    channel_keys,
    foreign,
)

ColumnFeatures = dict[str, dict[str, object]]
"""What LeRobot is told of each column, by name."""
VERSION = "v3.0"
_CAMERA = "observation.images."
COUNTER: dict[str, object] = {"dtype": "int64", "shape": [1], "names": None}
"""Feature of one integer a row."""


@dataclass(frozen=True, slots=True)
class ExportSource:
    """A run and its episodes.

    Attributes:
        shapes: (H, W, 3) of the images by camera; empty until its episodes are selected.
    """

    run: Run
    episodes: list[RecordedEpisode]
    joint_names: tuple[str, ...]
    pose_names: tuple[str, ...]
    cameras: tuple[str, ...]
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def robot_type(self) -> str | None:
        """Name of the robot from its files."""
        return read_about(self.run.files[0]).get("robot")


def camera_key(camera: str) -> str:
    """Feature of a camera."""
    return f"{_CAMERA}{camera}"


def cameras(features: Mapping[str, object]) -> tuple[str, ...]:
    """Cameras among the features."""
    return tuple(name.removeprefix(_CAMERA) for name in features if name.startswith(_CAMERA))


def features(rows: ColumnFeatures, fps: int, codec: Codec) -> ColumnFeatures:
    """Features of the columns: those of `rows`, and those that every data set has."""
    features = {name: dict(feature) for name, feature in rows.items()}
    for camera in cameras(rows):
        feature = features[camera_key(camera)]
        height, width, _ = cast("Sequence[int]", feature["shape"])
        feature["info"] = {
            "video.height": height,
            "video.width": width,
            "video.codec": codec,
            "video.pix_fmt": "yuv420p",
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = COUNTER
    return features


def row_features(source: ExportSource, shapes: Mapping[str, tuple[int, ...]]) -> ColumnFeatures:
    """Features with values from RoboNeuron; every data set has additional ones."""
    features: ColumnFeatures = {}
    if source.episodes[0].rows[0].joints.size:
        features["observation.state"] = vector("float32", source.joint_names)
    if source.episodes[0].rows[0].ee_pose.size:
        features["observation.ee_pose"] = vector("float32", source.pose_names)
    names = channel_keys(source.episodes[0].labels[0])
    features["action"] = vector("float32", names)
    features["roboneuron.action"] = vector("float64", names)
    features["roboneuron.policy_action"] = vector("float64", names)
    for camera, shape in shapes.items():
        features[camera_key(camera)] = video(shape)
    features["intervention"] = {"dtype": "bool", "shape": [1], "names": None}
    # none has "image" in its name, because lerobot treats such a feature as a camera's
    for name in ("roboneuron.who", "roboneuron.sent_ns", "roboneuron.seen_ns"):
        features[name] = COUNTER
    return features


def vector(dtype: str, names: Sequence[str]) -> dict[str, object]:
    """Feature with a value for each name."""
    return {"dtype": dtype, "shape": [len(names)], "names": list(names)}


def video(shape: Sequence[int]) -> dict[str, object]:
    """Feature of a camera with images of that shape, (H, W, 3)."""
    return {"dtype": "video", "shape": list(shape), "names": ["height", "width", "channels"]}


def array(pa: ModuleType, values: list[Any], feature: Mapping[str, Any]) -> Any:
    """Create a column of a pyarrow table, `pa`."""
    kinds = {
        "float32": pa.float32(),
        "float64": pa.float64(),
        "int64": pa.int64(),
        "bool": pa.bool_(),
    }
    kind, size = kinds[feature["dtype"]], feature["shape"][0]
    if feature["names"] is None:
        return pa.array(values, type=kind)
    flat = np.concatenate(values).astype(feature["dtype"])
    return pa.FixedSizeListArray.from_arrays(pa.array(flat, type=kind), size)


def tasks(pa: ModuleType, tasks: Sequence[str]) -> object:
    """Table of the tasks as pandas' index, by which lerobot reads them."""
    table = pa.table(
        {
            "task_index": pa.array(range(len(tasks)), pa.int64()),
            "task": pa.array(tasks, pa.string()),
        }
    )
    columns = [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
        },
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"},
    ]
    described = [{**column, "metadata": None} for column in columns]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": described,
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(pandas, allow_nan=False)})


def info(
    features: Mapping[str, object], counts: Mapping[str, int], fps: int, robot_type: str | None
) -> dict[str, object]:
    """Content of meta/info.json; `counts` of "episodes", "frames" and "tasks"."""
    return {
        "codebase_version": VERSION,
        "fps": fps,
        "features": features,
        **{f"total_{name}": count for name, count in counts.items()},
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "robot_type": robot_type,
        "splits": {"train": f"0:{counts['episodes']}"},
    }


def origin(
    sources: Sequence[ExportSource], episodes: Sequence[RecordedEpisode]
) -> dict[str, object]:
    """Units, frames and the origin of each episode."""
    about = read_about(sources[0].run.files[0])
    # a limit may be infinite, which JSON can only tell as text
    contract, config = (
        _spelled(foreign.decode_json(about.get(name, "{}"), name, has_constants=True))
        for name in ("contract", "config")
    )
    return {
        "contract": contract,
        "action_space": sources[0].episodes[0].labels[0],
        "rows": "one for each action that was sent; timestamp is frame_index / fps, "
        "roboneuron.sent_ns the time itself",
        "intervention": "a person moved the arm, alone or with the policy; action is then the "
        "displacement that was commanded, with the opening asked for last; "
        "roboneuron.policy_action is what the policy asked for",
        "roboneuron.who": dict(enumerate(WHO)),
        "config": config,
        "roboneuron": about.get("roboneuron", ""),
        "episodes": [
            {
                "run": e.run,
                "instruction": e.instruction,
                "outcome": e.outcome,
                "comment": e.comment,
                "begun_ns": e.rows[0].sent_ns,
            }
            for e in episodes
        ],
    }


def _spelled(value: object) -> object:
    """The value with "Infinity" and the like as text."""
    if isinstance(value, dict):
        return {name: _spelled(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_spelled(one) for one in value]
    is_odd = isinstance(value, float) and not math.isfinite(value)
    return json.dumps(value) if is_odd else value
