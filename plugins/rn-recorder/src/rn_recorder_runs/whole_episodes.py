"""Selection of episodes of recorded runs for one data set, with reasons for omissions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rn_recorder_runs.episodes import RecordedEpisode, read_episodes, stamp_of
from rn_recorder_runs.files import DAMAGE, read_records
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.lerobot_meta import ExportSource
from rn_recorder_runs.reading import RecordDecoder, camera_of
from rn_recorder_runs.store import Run
from roboneuron import InvalidInputError

Sizes = dict[str, dict[int, tuple[int, ...]]]
"""Size (H, W) of each required and decodable image, by camera and stamp [ns]."""
Kind = tuple[str, tuple[str, ...], tuple[tuple[str, tuple[int, ...]], ...], tuple[int, int]]
"""Label of the actions' control space; joint names; size of images (H, W) by camera; values of
joints and pose in a row.
"""
_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True, slots=True)
class Skipped:
    """An omitted episode or run."""

    run: str
    instruction: str
    why: str

    def __str__(self) -> str:
        """One line."""
        what = f"the episode {self.instruction!r} of " if self.instruction else ""
        return f"{what}{self.run}: {self.why}"


def whole_sources(
    runs: Sequence[Run], outcome: str | None
) -> tuple[list[ExportSource], list[Skipped]]:
    """Runs with the episodes that can be written, and the omitted ones.

    The majority of the episodes determines the joints, cameras and image sizes of the data set,
    because LeRobot's files contain one kind of row.
    """
    read: list[tuple[ExportSource, Sizes]] = []
    skipped: list[Skipped] = []
    for run in runs:
        try:
            source = _read(run, outcome)
            read.append((source, _sizes(run, source)))
        except (InvalidInputError, OSError, *DAMAGE) as error:
            skipped.append(Skipped(run.id, "", str(error).rstrip(".")))
    kinds = Counter[Kind]()
    kept: list[tuple[ExportSource, list[tuple[RecordedEpisode, Kind]]]] = []
    for source, sizes in read:
        whole: list[tuple[RecordedEpisode, Kind]] = []
        for episode in source.episodes:
            kind = _kind(source, episode, sizes)
            if isinstance(kind, str):
                skipped.append(Skipped(source.run.id, episode.instruction, kind))
            else:
                whole.append((episode, kind))
                kinds[kind] += 1
        kept.append((source, whole))
    if not kinds:
        return [], skipped
    wanted = kinds.most_common(1)[0][0]
    sources = []
    for source, found in kept:
        alike = [episode for episode, kind in found if kind == wanted]
        skipped += [
            Skipped(
                source.run.id,
                episode.instruction,
                f"{_differences(kind, wanted)}; export it by itself",
            )
            for episode, kind in found
            if kind != wanted
        ]
        if alike:
            shapes = {camera: (*size, 3) for camera, size in wanted[2]}
            sources.append(replace(source, episodes=alike, shapes=shapes))
    return sources, skipped


def _kind(source: ExportSource, episode: RecordedEpisode, sizes: Sizes) -> Kind | str:
    """Properties in which the episodes of a data set must agree, or the reason why this one cannot
    be written.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for camera in source.cameras:
        for row in episode.rows:
            shape = sizes[camera].get(row.images[camera])
            if shape is None:
                at_s = (row.sent_ns - episode.rows[0].sent_ns) / 1e9
                lost = sum(one.images[camera] not in sizes[camera] for one in episode.rows)
                missing = f"{lost} of its {len(episode.rows)} images of camera {camera!r}"
                return f"{missing} are lost or damaged, the first at {at_s:.2f} s"
            if shapes.setdefault(camera, shape) != shape:
                return f"images of camera {camera!r} change from {shapes[camera]} to {shape}"
        height, width = shapes[camera]
        if height % 2 or width % 2:
            return (
                f"images of camera {camera!r} are {width}x{height} px, and videos need even sizes"
            )
    joints = {row.joints.size for row in episode.rows}
    poses = {row.ee_pose.size for row in episode.rows}
    if len(joints) > 1 or len(poses) > 1:
        return "joint states or TCP poses begin only after its first action"
    labels = episode.labels
    if len(labels) > 1:
        return f"its actions change from one control space to another ({' to '.join(labels)})"
    untold = sum(not row.action.size for row in episode.rows)
    if untold:
        return (
            f"what a person did is not recorded as {labels[0]} in {untold} of its "
            f"{len(episode.rows)} rows"
        )
    endless = _not_finite(episode)
    if endless:
        return endless
    return (
        labels[0],
        source.joint_names,
        tuple(sorted(shapes.items())),
        (joints.pop(), poses.pop()),
    )


def _not_finite(episode: RecordedEpisode) -> str:
    """Reason why the episode cannot be written if a number of it is not finite as float32, as a
    node of others may send one; "" otherwise.
    """
    for row in episode.rows:
        numbers = {
            "action": row.action,
            "action of the policy": row.policy_action,
            "joint state": row.joints,
            "TCP pose": row.ee_pose,
        }
        for what, values in numbers.items():
            # compared instead of converted, because NumPy warns of an overflow
            if not (np.abs(values) <= _LARGEST).all():
                at_s = (row.sent_ns - episode.rows[0].sent_ns) / 1e9
                return f"its {what} at {at_s:.2f} s is not finite or too large for float32"
    return ""


def _differences(kind: Kind, wanted: Kind) -> str:
    """Differences between an episode and the data set."""
    words = ("control spaces", "joints", "cameras or sizes of images", "states")
    return "it has other " + ", ".join(
        f"{word} ({got}, not {expected})"
        for word, got, expected in zip(words, kind, wanted, strict=True)
        if got != expected
    )


def _read(run: Run, outcome: str | None) -> ExportSource:
    episodes, streams = read_episodes(run.id, run.files, run.facts)
    kept = [episode for episode in episodes if outcome is None or episode.outcome == outcome]
    cameras = tuple(sorted(streams.images))
    return ExportSource(run, kept, streams.joint_names, streams.pose_names, cameras)


def _sizes(run: Run, source: ExportSource) -> Sizes:
    """Decode the images needed by the episodes: a present image may still be damaged."""
    needed = {
        camera: {row.images[camera] for episode in source.episodes for row in episode.rows}
        for camera in source.cameras
    }
    found: Sizes = {camera: {} for camera in source.cameras}
    decoder = RecordDecoder()
    for record in (
        record for path in run.files for record in read_records(path, decoder.definitions)
    ):
        camera = camera_of(record.topic)
        if camera not in needed:
            continue
        stamp_ns = stamp_of(record.data)
        if stamp_ns not in needed[camera] or stamp_ns in found[camera]:
            continue
        try:
            found[camera][stamp_ns] = pixels_of(decoder.decode(record), record.type).shape[:2]
        except (InvalidInputError, *DAMAGE):
            needed[camera].discard(stamp_ns)
    return found
