"""Files of a LeRobotDataset v3: parquet, one video for each camera, statistics, tasks.

Source of the layout: lerobot 0.6.1, `datasets/utils.py`, `datasets/dataset_writer.py` and a data
set written by it.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs import lerobot_meta as meta
from rn_recorder_runs.lerobot_process import lerobot_writer
from rn_recorder_runs.statistics import Stats, image_stats, merge, stats_of
from rn_recorder_runs.video import CameraVideo, Codec, sample_every
from roboneuron import (
    ConfigurationError,
    MissingDependencyError,
    StateError,
    install_command,
)

_FILE = "chunk-000/file-000"


@dataclass(frozen=True, slots=True)
class DataSetEpisode:
    """One episode to be written.

    Attributes:
        rows: their number.
        values: by feature, one for each row, in the types of the format's features.
        pictures: yields the images by camera for each row, uint8 (H, W, 3) RGB; may go on with
            those of the next episode.
    """

    instruction: str
    rows: int
    values: Mapping[str, Sequence[object]]
    pictures: Iterator[Mapping[str, NDArray[np.uint8]]]


@dataclass(frozen=True, slots=True)
class DataSetFormat:
    """What all rows of a data set have in common.

    Attributes:
        features: of the values and cameras, without those that every data set has.
    """

    features: meta.ColumnFeatures
    fps: int
    codec: Codec
    robot_type: str | None

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return meta.cameras(self.features)


@contextmanager
def complete_directory(directory: Path, with_lerobot: Path | None) -> Iterator[Path]:
    """Yield a hidden directory next to `directory`, which becomes it if the block succeeds and is
    deleted otherwise.

    Args:
        with_lerobot: an interpreter whose lerobot writes, so that pyarrow is not needed here.

    Raises:
        ConfigurationError: the directory exists.
        StateError: it cannot be written.
        MissingDependencyError: pyarrow is not installed.
    """
    if with_lerobot is None and find_spec("pyarrow") is None:
        raise MissingDependencyError(
            "Data sets need pyarrow.",
            hint=f"Run: {install_command('rn-recorder[export]')}.",
        )
    if directory.exists():
        raise ConfigurationError(f"{directory} exists.", hint="Name another folder, or delete it.")
    unfinished = directory.with_name(f".{directory.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        yield unfinished
        unfinished.rename(directory)
    except OSError as error:
        raise StateError(
            f"{error.filename or directory} cannot be written: {error.strerror or error}.",
            hint="Free space on that disk or mend the permissions; nothing of the data set was "
            "left.",
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def write_data_set(
    directory: Path,
    form: DataSetFormat,
    episodes: Iterable[DataSetEpisode],
    origin: Mapping[str, object],
    with_lerobot: Path | None = None,
) -> None:
    """Write the episodes in their order.

    Args:
        directory: must not exist yet.
        origin: written to meta/roboneuron.json.
        with_lerobot: an interpreter with lerobot, whose own writer is then used.

    Raises:
        ConfigurationError: there is no such interpreter.
        StateError: a number of the metadata is not finite, or lerobot has failed.
        MissingDependencyError: PyAV is not installed, or lerobot is missing.
        OSError: the directory cannot be written.
    """
    if with_lerobot is None:
        _write(directory, form, episodes)
    else:
        _write_with_lerobot(with_lerobot, directory, form, episodes)
    _write_json(directory / "meta/roboneuron.json", origin)


def _write_with_lerobot(
    python: Path, directory: Path, form: DataSetFormat, episodes: Iterable[DataSetEpisode]
) -> None:
    with lerobot_writer(
        python,
        directory,
        fps=form.fps,
        features=form.features,
        robot_type=form.robot_type,
        codec=form.codec,
    ) as writer:
        for episode in episodes:
            writer.begin(episode.instruction)
            for number, images in enumerate(islice(episode.pictures, episode.rows)):
                row = {name: np.asarray(column[number]) for name, column in episode.values.items()}
                for camera, image in images.items():
                    row[meta.camera_key(camera)] = image
                writer.add(row)
            writer.end()
    shutil.rmtree(directory / "images", ignore_errors=True)  # empty folders that lerobot leaves


def _write(directory: Path, form: DataSetFormat, episodes: Iterable[DataSetEpisode]) -> None:
    import pyarrow as pa  # heavy
    import pyarrow.parquet as pq

    videos = {
        camera: CameraVideo(
            directory / f"videos/{meta.camera_key(camera)}/{_FILE}.mp4", form.fps, form.codec
        )
        for camera in form.cameras
    }
    tasks: dict[str, int] = {}
    columns: dict[str, list[object]] = {}
    listed: list[dict[str, object]] = []
    parts: list[dict[str, Stats]] = []
    begin = 0
    try:
        for episode in episodes:
            sample = _write_videos(episode.rows, episode.pictures, videos)
            task = tasks.setdefault(episode.instruction, len(tasks))
            counters = _counters(episode.rows, len(listed), begin, task, form.fps)
            rows = {**episode.values, **counters}
            stats = {name: stats_of(_matrix(values)) for name, values in rows.items()}
            stats |= {
                meta.camera_key(camera): image_stats(*sample[camera]) for camera in form.cameras
            }
            parts.append(stats)
            listed.append(_episode_entry(episode, len(listed), begin, form, stats))
            for name, values in rows.items():
                columns.setdefault(name, []).extend(values)
            begin += episode.rows
    finally:
        for video in videos.values():
            video.close()
    features = meta.features(form.features, form.fps, form.codec)
    table = pa.table(
        {name: meta.array(pa, values, features[name]) for name, values in columns.items()}
    )
    for name, written in (
        (f"data/{_FILE}.parquet", table),
        (f"meta/episodes/{_FILE}.parquet", pa.Table.from_pylist(listed)),
        ("meta/tasks.parquet", meta.tasks(pa, list(tasks))),
    ):
        path = directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(written, path)
    whole = {name: merge([part[name] for part in parts]).to_lists() for name in parts[0]}
    _write_json(directory / "meta/stats.json", whole)
    counts = {"episodes": len(listed), "frames": begin, "tasks": len(tasks)}
    info = meta.info(features, counts, form.fps, form.robot_type)
    _write_json(directory / "meta/info.json", info)


def _write_videos(
    rows: int,
    pictures: Iterator[Mapping[str, NDArray[np.uint8]]],
    videos: Mapping[str, CameraVideo],
) -> dict[str, tuple[NDArray[np.float64], int]]:
    """Add the images of an episode, and return sampled pixels by camera."""
    for images in islice(pictures, rows):
        for camera, video in videos.items():
            video.add(images[camera], 1, sample_every(rows))
    return {camera: video.take_sample() for camera, video in videos.items()}


def _counters(count: int, index: int, begin: int, task: int, fps: int) -> dict[str, list[object]]:
    """Indices of the rows in the data set."""
    return {
        "timestamp": [np.float32(number / fps) for number in range(count)],
        "frame_index": list(range(count)),
        "episode_index": [index] * count,
        "index": list(range(begin, begin + count)),
        "task_index": [task] * count,
    }


def _matrix(values: Sequence[object]) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)
    return array.reshape(len(values), -1)


def _episode_entry(
    episode: DataSetEpisode,
    index: int,
    begin: int,
    form: DataSetFormat,
    stats: Mapping[str, Stats],
) -> dict[str, object]:
    length = episode.rows
    entry: dict[str, object] = {
        "episode_index": index,
        "tasks": [episode.instruction],
        "length": length,
    }
    entry |= {"data/chunk_index": 0, "data/file_index": 0}
    entry |= {"dataset_from_index": begin, "dataset_to_index": begin + length}
    for camera in form.cameras:
        key = f"videos/{meta.camera_key(camera)}"
        entry |= {f"{key}/chunk_index": 0, f"{key}/file_index": 0}
        entry |= {
            f"{key}/from_timestamp": begin / form.fps,
            f"{key}/to_timestamp": (begin + length) / form.fps,
        }
    for name, values in stats.items():
        entry |= {f"stats/{name}/{key}": value for key, value in values.to_lists().items()}
    return entry | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}


def _write_json(path: Path, value: Mapping[str, object]) -> None:
    """Write a file of JSON. Raises StateError for a number that JSON does not have."""
    try:
        text = json.dumps(value, indent=2, allow_nan=False)
    except ValueError as error:
        raise StateError(
            f"{path.name} would contain a number that is not finite.",
            hint="Export the runs one by one to find the one that contains it.",
        ) from error
    path.write_text(text, encoding="utf-8")
