"""Export of episodes as a LeRobotDataset v3: parquet, one video for each camera, statistics, tasks.

Source of the layout: lerobot 0.6.1, `datasets/utils.py`, `datasets/dataset_writer.py` and a data
set written by it.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs import lerobot_meta as meta
from rn_recorder_runs.acted import LED, WHO
from rn_recorder_runs.episodes import RecordedEpisode, stamp_of
from rn_recorder_runs.files import Record, read_records
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.interventions import cut
from rn_recorder_runs.lerobot_meta import ExportSource
from rn_recorder_runs.lerobot_process import lerobot_writer
from rn_recorder_runs.reading import RecordDecoder, camera_of
from rn_recorder_runs.statistics import Stats, image_stats, merge, stats_of
from rn_recorder_runs.store import Run
from rn_recorder_runs.video import CameraVideo, Codec, sample_every
from rn_recorder_runs.whole_episodes import Skipped, whole_sources
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    MissingDependencyError,
    StateError,
    install_command,
)

_FILE = "chunk-000/file-000"


@dataclass(frozen=True, slots=True)
class Written:
    """Result of an export.

    Attributes:
        skipped: omitted parts: run, instruction ("" for a whole run), and the reason.
    """

    episodes: int
    frames: int
    fps: int
    skipped: tuple[Skipped, ...] = ()


def export(
    runs: Sequence[Run],
    directory: Path,
    *,
    outcome: str | None,
    fps: int | None,
    codec: Codec,
    with_lerobot: Path | None = None,
    only_interventions: bool = False,
) -> Written:
    """Write the episodes of these runs; incomplete ones are left out and listed in the result.

    The directory appears when it is complete. Until then everything is in a hidden directory next
    to it, which is deleted if the export fails.

    Args:
        runs: in this order.
        directory: must not exist yet.
        outcome: only episodes with this outcome.
        fps: rows per second; by default the rate at which actions were sent.
        codec: codec of the videos.
        with_lerobot: an interpreter with lerobot, whose own writer is then used; by default the
            files are written without lerobot.
        only_interventions: each span in which a person moved the arm is an episode; the others are
            left out.

    Raises:
        ConfigurationError: the directory exists, or there is no such interpreter.
        InvalidInputError: there is nothing to export, or nothing complete; names the reason for
            each.
        StateError: the directory cannot be written, or lerobot has failed.
        MissingDependencyError: pyarrow or PyAV is not installed, or lerobot is missing.
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
        written = _export(runs, unfinished, outcome, fps, codec, with_lerobot, only_interventions)
        unfinished.rename(directory)
    except OSError as error:
        raise StateError(
            f"{error.filename or directory} cannot be written: {error.strerror or error}.",
            hint="Free space on that disk or mend the permissions; nothing of the data set was "
            "left.",
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return written


def _export(
    runs: Sequence[Run],
    directory: Path,
    outcome: str | None,
    fps: int | None,
    codec: Codec,
    with_lerobot: Path | None,
    only_interventions: bool,
) -> Written:
    sources, skipped = whole_sources(runs, outcome)
    if only_interventions:
        sources = [replace(source, episodes=cut(source.episodes)) for source in sources]
        sources = [source for source in sources if source.episodes]
    episodes = [episode for source in sources for episode in source.episodes]
    if not episodes:
        raise InvalidInputError(
            f"No {'intervention' if only_interventions else 'episode'}"
            f"{f' with the outcome {outcome!r}' if outcome else ''} in these runs can be exported.",
            hint=" ".join(f"{left}." for left in skipped),
        )
    rate = fps or _rate(episodes)
    if with_lerobot is None:
        _write(sources, directory, rate, codec)
    else:
        _write_with_lerobot(with_lerobot, sources, directory, rate, codec)
    _write_json(directory / "meta/roboneuron.json", meta.origin(sources, episodes))
    frames = sum(len(episode.rows) for episode in episodes)
    return Written(len(episodes), frames, rate, tuple(skipped))


def _write_with_lerobot(
    python: Path, sources: Sequence[ExportSource], directory: Path, rate: int, codec: Codec
) -> None:
    first = sources[0]
    features = meta.row_features(first, first.shapes)
    with lerobot_writer(
        python,
        directory,
        fps=rate,
        features=features,
        robot_type=first.robot_type,
        codec=codec,
    ) as writer:
        for source in sources:
            pictures = row_images(source)
            for episode in source.episodes:
                writer.begin(episode.instruction)
                values = _values(episode)
                for number, images in enumerate(islice(pictures, len(episode.rows))):
                    row = {name: np.asarray(column[number]) for name, column in values.items()}
                    for camera, image in images.items():
                        row[f"observation.images.{camera}"] = image
                    writer.add(row)
                writer.end()
    shutil.rmtree(directory / "images", ignore_errors=True)  # empty folders that lerobot leaves


def _write(sources: Sequence[ExportSource], directory: Path, rate: int, codec: Codec) -> None:
    import pyarrow as pa  # heavy
    import pyarrow.parquet as pq

    first = sources[0]
    episodes = [episode for source in sources for episode in source.episodes]
    videos = {
        camera: CameraVideo(
            directory / f"videos/observation.images.{camera}/{_FILE}.mp4", rate, codec
        )
        for camera in first.cameras
    }
    tasks = list(dict.fromkeys(episode.instruction for episode in episodes))
    columns: dict[str, list[object]] = {}
    listed: list[dict[str, object]] = []
    parts: list[dict[str, Stats]] = []
    begin = 0
    try:
        for source in sources:
            pictures = row_images(source)
            for episode in source.episodes:
                sample = _write_videos(len(episode.rows), pictures, videos)
                task = tasks.index(episode.instruction)
                rows = _values(episode) | _counters(episode, len(listed), begin, task, rate)
                stats = {name: stats_of(_matrix(values)) for name, values in rows.items()}
                stats |= {
                    f"observation.images.{camera}": image_stats(*sample[camera])
                    for camera in first.cameras
                }
                parts.append(stats)
                listed.append(
                    _episode_entry(episode, len(listed), begin, rate, first.cameras, stats)
                )
                for name, values in rows.items():
                    columns.setdefault(name, []).extend(values)
                begin += len(episode.rows)
    finally:
        for video in videos.values():
            video.close()
    features = meta.features(first, first.shapes, rate, codec)
    table = pa.table(
        {name: meta.array(pa, values, features[name]) for name, values in columns.items()}
    )
    for name, written in (
        (f"data/{_FILE}.parquet", table),
        (f"meta/episodes/{_FILE}.parquet", pa.Table.from_pylist(listed)),
        ("meta/tasks.parquet", meta.tasks(pa, tasks)),
    ):
        path = directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(written, path)
    whole = {name: merge([part[name] for part in parts]).to_lists() for name in parts[0]}
    _write_json(directory / "meta/stats.json", whole)
    _write_json(directory / "meta/info.json", meta.info(first, features, episodes, tasks, rate))


def _rate(episodes: Sequence[RecordedEpisode]) -> int:
    gaps = [
        np.diff([row.sent_ns for row in episode.rows])
        for episode in episodes
        if len(episode.rows) > 1
    ]
    if not gaps:
        raise InvalidInputError(
            "No episode has two actions, so there is no rate.", hint="Give --fps."
        )
    return max(1, round(1e9 / float(np.median(np.concatenate(gaps)))))


def _write_videos(
    rows: int,
    pictures: Iterator[dict[str, NDArray[np.uint8]]],
    videos: Mapping[str, CameraVideo],
) -> dict[str, tuple[NDArray[np.float64], int]]:
    """Add the images of an episode, and return sampled pixels by camera."""
    for images in islice(pictures, rows):
        for camera, video in videos.items():
            video.add(images[camera], 1, sample_every(rows))
    return {camera: video.take_sample() for camera, video in videos.items()}


def _values(episode: RecordedEpisode) -> dict[str, list[object]]:
    """The recorded values, one for each row, in the types of `meta.row_features`."""
    rows = episode.rows
    leading = next(iter(rows[0].images))
    columns: dict[str, list[object]] = {}
    if rows[0].joints.size:
        columns["observation.state"] = [row.joints.astype(np.float32) for row in rows]
    if rows[0].ee_pose.size:
        columns["observation.ee_pose"] = [row.ee_pose.astype(np.float32) for row in rows]
    columns["action"] = [row.action.astype(np.float32) for row in rows]
    columns["roboneuron.action"] = [row.action for row in rows]
    columns["roboneuron.policy_action"] = [row.policy_action for row in rows]
    columns["intervention"] = [row.who in LED for row in rows]
    columns["roboneuron.who"] = [np.int64(WHO.index(row.who)) for row in rows]
    columns["roboneuron.sent_ns"] = [np.int64(row.sent_ns) for row in rows]
    columns["roboneuron.seen_ns"] = [np.int64(row.images[leading]) for row in rows]
    return columns


def _counters(
    episode: RecordedEpisode, index: int, begin: int, task: int, fps: int
) -> dict[str, list[object]]:
    """Indices of the rows in the data set."""
    count = len(episode.rows)
    return {
        "timestamp": [np.float32(number / fps) for number in range(count)],
        "frame_index": list(range(count)),
        "episode_index": [index] * count,
        "index": list(range(begin, begin + count)),
        "task_index": [task] * count,
    }


def _matrix(values: list[object]) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)
    return array.reshape(len(values), -1)


def _episode_entry(
    episode: RecordedEpisode,
    index: int,
    begin: int,
    fps: int,
    cameras: Sequence[str],
    stats: Mapping[str, Stats],
) -> dict[str, object]:
    length = len(episode.rows)
    entry: dict[str, object] = {
        "episode_index": index,
        "tasks": [episode.instruction],
        "length": length,
    }
    entry |= {"data/chunk_index": 0, "data/file_index": 0}
    entry |= {"dataset_from_index": begin, "dataset_to_index": begin + length}
    for camera in cameras:
        key = f"videos/observation.images.{camera}"
        entry |= {f"{key}/chunk_index": 0, f"{key}/file_index": 0}
        entry |= {
            f"{key}/from_timestamp": begin / fps,
            f"{key}/to_timestamp": (begin + length) / fps,
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


def row_images(source: ExportSource) -> Iterator[dict[str, NDArray[np.uint8]]]:
    """Yield the images by camera for each row of each episode, uint8 (H, W, 3) RGB.

    One pass through the files; an image is kept undecoded until the last row that needs it.
    """
    rows = deque(
        {camera: row.images[camera] for camera in source.cameras}
        for episode in source.episodes
        for row in episode.rows
    )
    needed = {camera: Counter(row[camera] for row in rows) for camera in source.cameras}
    held: dict[str, dict[int, Record]] = {camera: {} for camera in source.cameras}
    decoder = RecordDecoder()
    for path in source.run.files:
        for record in read_records(path, decoder.definitions):
            camera = camera_of(record.topic)
            if camera not in needed or not needed[camera][stamp_of(record.data)]:
                continue
            held[camera].setdefault(stamp_of(record.data), record)
            while rows and all(stamp_ns in held[name] for name, stamp_ns in rows[0].items()):
                row = rows.popleft()
                found = {name: held[name][stamp_ns] for name, stamp_ns in row.items()}
                yield {
                    name: pixels_of(decoder.decode(record), record.type)
                    for name, record in found.items()
                }
                for name, stamp_ns in row.items():
                    needed[name][stamp_ns] -= 1
                    if not needed[name][stamp_ns]:
                        del held[name][stamp_ns]
    assert not rows, "all images were there when the episodes were chosen"
