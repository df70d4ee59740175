"""Export of the episodes of recorded runs as a LeRobotDataset v3."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs import lerobot_meta as meta
from rn_recorder_runs.acted import LED, WHO
from rn_recorder_runs.data_sets import (
    DataSetEpisode,
    DataSetFormat,
    complete_directory,
    write_data_set,
)
from rn_recorder_runs.episodes import RecordedEpisode, stamp_of
from rn_recorder_runs.files import Record, read_records
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.interventions import cut
from rn_recorder_runs.lerobot_meta import ExportSource
from rn_recorder_runs.reading import RecordDecoder, camera_of
from rn_recorder_runs.store import Run
from rn_recorder_runs.video import Codec
from rn_recorder_runs.whole_episodes import Skipped, whole_sources
from roboneuron import InvalidInputError


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
    with complete_directory(directory, with_lerobot) as unfinished:
        return _export(runs, unfinished, outcome, fps, codec, with_lerobot, only_interventions)


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
    first = sources[0]
    form = DataSetFormat(meta.row_features(first, first.shapes), rate, codec, first.robot_type)
    origin = meta.origin(sources, episodes)
    write_data_set(directory, form, _written_episodes(sources), origin, with_lerobot)
    frames = sum(len(episode.rows) for episode in episodes)
    return Written(len(episodes), frames, rate, tuple(skipped))


def _written_episodes(sources: Sequence[ExportSource]) -> Iterator[DataSetEpisode]:
    for source in sources:
        pictures = row_images(source)
        for episode in source.episodes:
            values = _values(episode)
            yield DataSetEpisode(episode.instruction, len(episode.rows), values, pictures)


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
