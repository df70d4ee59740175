"""Import of bags as one data set."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rn_recorder_bags.bag_files import Bag, find_bag, read_bag
from rn_recorder_bags.mapping import BagMapping
from rn_recorder_bags.samples import U8, VIDEO, Pictures
from rn_recorder_bags.sampling import SampledEpisode, sample
from rn_recorder_bags.scanning import scan
from rn_recorder_runs import lerobot_meta as meta
from rn_recorder_runs.data_sets import (
    DataSetEpisode,
    DataSetFormat,
    complete_directory,
    write_data_set,
)
from rn_recorder_runs.files import Record
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.lerobot import Written
from rn_recorder_runs.reading import RecordDecoder
from rn_recorder_runs.video import Codec
from rn_recorder_runs.whole_episodes import Skipped
from roboneuron import InvalidInputError

Shapes = tuple[tuple[str, tuple[int, ...]], ...]
"""Shape (H, W, 3) of the images by camera."""
TIME = "roboneuron.row_ns"
"""Feature with the time of a row in its bag [ns]."""


@dataclass(frozen=True, slots=True)
class _Sampled:
    """A bag, and its episodes."""

    bag: Bag
    episodes: list[SampledEpisode]


def import_bags(
    paths: Sequence[Path],
    mapping: BagMapping,
    directory: Path,
    *,
    codec: Codec,
    with_lerobot: Path | None = None,
) -> Written:
    """Write the episodes of these bags as a LeRobotDataset v3; what is bad is left out and listed
    in the result.

    Args:
        paths: bags, in this order.
        mapping: what their topics are.
        directory: must not exist yet; appears when it is complete.
        codec: of the videos.
        with_lerobot: an interpreter with lerobot, whose own writer is then used.

    Raises:
        ConfigurationError: the directory exists, or there is no such interpreter.
        InvalidInputError: no bag has an episode; names the reason for each.
        StateError: the directory cannot be written, or lerobot has failed.
        MissingDependencyError: pyarrow or PyAV is not installed, or lerobot is missing.
    """
    with complete_directory(directory, with_lerobot) as unfinished:
        sampled, skipped = _sample(paths, mapping)
        kept, shapes, others = _alike(sampled)
        skipped += others
        episodes = [(bag, episode) for bag in kept for episode in bag.episodes]
        if not episodes:
            raise InvalidInputError(
                "No episode in these bags can be imported.",
                hint=" ".join(f"{left}." for left in skipped),
            )
        form = DataSetFormat(_features(mapping, shapes), mapping.fps, codec, mapping.robot)
        origin = {
            "imported": mapping.model_dump(mode="json", exclude_none=True),
            "rows": "one a period; state and images are the newest before it, the action is the "
            "newest before the next row, or its state",
            TIME: f"time of the row by the {mapping.time}'s clock [ns]",
            "episodes": [
                {"bag": one.bag.name, "instruction": episode.instruction, "rows": episode.rows}
                for one, episode in episodes
            ],
            "left_out": [str(left) for left in skipped],
        }
        written = _written(kept, mapping, [camera for camera, _ in shapes])
        write_data_set(unfinished, form, written, origin, with_lerobot)
        frames = sum(episode.rows for _, episode in episodes)
        return Written(len(episodes), frames, mapping.fps, tuple(skipped))


def _sample(paths: Sequence[Path], mapping: BagMapping) -> tuple[list[_Sampled], list[Skipped]]:
    sampled: list[_Sampled] = []
    skipped: list[Skipped] = []
    for path in paths:
        try:
            found = scan(find_bag(path), mapping)
            episodes, gaps = sample(found, mapping)
        except (InvalidInputError, OSError) as error:
            skipped.append(Skipped(path.name, "", str(error).rstrip(".")))
            continue
        skipped += [Skipped(found.bag.name, "", why) for why in (*found.left_out, *gaps)]
        sampled.append(_Sampled(found.bag, episodes))
    return sampled, skipped


def _alike(sampled: Sequence[_Sampled]) -> tuple[list[_Sampled], Shapes, list[Skipped]]:
    """The bags with the episodes that have the cameras and sizes of most, and the other ones."""
    skipped: list[Skipped] = []
    kinds: list[list[tuple[SampledEpisode, Shapes]]] = []
    for one in sampled:
        found: list[tuple[SampledEpisode, Shapes]] = []
        for episode in one.episodes:
            shapes = _shapes(episode)
            if isinstance(shapes, str):
                skipped.append(Skipped(one.bag.name, episode.instruction, shapes))
            else:
                found.append((episode, shapes))
        kinds.append(found)
    counts = Counter(shapes for found in kinds for _, shapes in found)
    if not counts:
        return [], (), skipped
    wanted = counts.most_common(1)[0][0]
    kept = []
    for one, found in zip(sampled, kinds, strict=True):
        kept.append(_Sampled(one.bag, [episode for episode, shapes in found if shapes == wanted]))
        skipped += [
            Skipped(
                one.bag.name,
                episode.instruction,
                f"it has the images {dict(shapes)}, most have {dict(wanted)}",
            )
            for episode, shapes in found
            if shapes != wanted
        ]
    return kept, wanted, skipped


def _shapes(episode: SampledEpisode) -> Shapes | str:
    """Shapes of the images by camera, or why they cannot be written."""
    found = []
    for camera, pictures in episode.pictures.items():
        shapes = {picture.shape for picture in pictures}
        shape = shapes.pop()
        if shapes:
            return f"images of camera {camera!r} change their size"
        if shape[0] % 2 or shape[1] % 2:
            size = f"{shape[1]}x{shape[0]} px"
            return f"images of camera {camera!r} are {size}, and videos need even sizes"
        found.append((camera, shape))
    return tuple(found)


def _features(mapping: BagMapping, shapes: Shapes) -> meta.ColumnFeatures:
    features: meta.ColumnFeatures = {
        name: meta.vector("float32", [ours for one in sources for ours in one.values.values()])
        for name, sources in (
            ("observation.state", mapping.state),
            ("action", mapping.actions),
        )
    }
    for camera, shape in shapes:
        features[meta.camera_key(camera)] = meta.video(shape)
    return {**features, TIME: meta.COUNTER}


def _written(
    sampled: Sequence[_Sampled], mapping: BagMapping, cameras: Sequence[str]
) -> Iterator[DataSetEpisode]:
    for one in sampled:
        pictures = row_pictures(one.bag, mapping, cameras, one.episodes)
        for episode in one.episodes:
            values: dict[str, Sequence[object]] = {
                "observation.state": list(episode.state.astype(np.float32)),
                "action": list(episode.action.astype(np.float32)),
                TIME: list(episode.times_ns),
            }
            yield DataSetEpisode(episode.instruction, episode.rows, values, pictures)


def row_pictures(
    bag: Bag, mapping: BagMapping, cameras: Sequence[str], episodes: Sequence[SampledEpisode]
) -> Iterator[Mapping[str, U8]]:
    """Yield the images by camera for each row of each episode, uint8 (H, W, 3) RGB.

    One pass through the bag; an image that is no video frame is kept undecoded until its rows.
    """
    rows = deque(
        {camera: episode.pictures[camera][row].number for camera in cameras}
        for episode in episodes
        for row in range(episode.rows)
    )
    needed = Counter(number for row in rows for number in row.values())
    if not needed:
        yield from ({} for _ in rows)
        return
    topics = {mapping.cameras[camera].topic for camera in cameras}
    decoder = RecordDecoder()
    held: dict[int, Record | U8] = {}
    for number, picture in _pictures(bag, topics, decoder):
        if needed[number]:
            held[number] = picture
        while rows and all(number in held for number in rows[0].values()):
            row = rows.popleft()
            yield {camera: _pixels(held[number], decoder) for camera, number in row.items()}
            for number in row.values():
                needed[number] -= 1
                if not needed[number]:
                    del held[number]
    assert not rows, "all images were there when the episodes were sampled"


def _pictures(
    bag: Bag, topics: Collection[str], decoder: RecordDecoder
) -> Iterator[tuple[int, Record | U8]]:
    """Image messages of a bag with their numbers; of videos the frames."""
    videos: dict[str, Pictures] = {}
    for number, record in enumerate(read_bag(bag, [])):
        if record.topic not in topics:
            continue
        if record.type != VIDEO:
            yield number, record
            continue
        video = videos.setdefault(record.topic, Pictures())
        try:
            yield from video.decode(number, decoder.decode(record), record.type)
        except (ValueError, InvalidInputError):  # told when the bag was scanned
            video.lose()
    for video in videos.values():
        yield from video.finish()


def _pixels(picture: Record | U8, decoder: RecordDecoder) -> U8:
    if isinstance(picture, Record):
        return pixels_of(decoder.decode(picture), picture.type)
    return picture
