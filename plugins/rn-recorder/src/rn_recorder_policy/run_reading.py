"""One episode of a RoboNeuron recording as a demonstration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.demonstration import ACTION, IMAGES, STATE, Column, Demonstration
from rn_recorder_runs.episodes import RecordedEpisode, read_episodes, stamp_of
from rn_recorder_runs.files import read_about, read_records
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.reading import RecordDecoder, camera_of
from roboneuron import InvalidInputError, channel_keys

U8 = NDArray[np.uint8]


def read_run(files: Sequence[Path], episode: int) -> Demonstration:
    """Read an episode of the run in these MCAP files, oldest first.

    Raises:
        InvalidInputError: there is no such episode, or it has fewer than two actions.
    """
    first = files[0]
    name = first.parent.name if first.stem.startswith("part-") else first.stem
    episodes, streams = read_episodes(name, files, dict(read_about(files[0])))
    if not 0 <= episode < len(episodes):
        raise InvalidInputError(
            f"The run {name!r} has no episode {episode}.",
            hint=f"It has {len(episodes)}, counted from 0.",
        )
    found = episodes[episode]
    if len(found.rows) < 2:
        raise InvalidInputError(f"Episode {episode} of the run {name!r} has a single action.")
    if len(found.labels) > 1:
        raise InvalidInputError(
            f"The actions of episode {episode} change from one control space to another: "
            f"{', '.join(found.labels)}."
        )
    columns = {
        ACTION: Column(
            names=channel_keys(found.labels[0]),
            values=np.stack([row.policy_action for row in found.rows]),
        )
    }
    if all(row.joints.size == len(streams.joint_names) > 0 for row in found.rows):
        columns[STATE] = Column(
            names=streams.joint_names, values=np.stack([row.joints for row in found.rows])
        )
    if all(row.ee_pose.size == len(streams.pose_names) for row in found.rows):
        columns["observation.ee_pose"] = Column(
            names=streams.pose_names, values=np.stack([row.ee_pose for row in found.rows])
        )
    period_s = float(np.median(np.diff([row.sent_ns for row in found.rows]))) / 1e9
    return Demonstration(
        source=f"episode {episode} of the run {name!r}",
        fps=1.0 / period_s,
        instruction=found.instruction,
        columns=columns,
        cameras=tuple(f"{IMAGES}{camera}" for camera in sorted(streams.images)),
        read_pictures=_RunPictures(files, found).read,
    )


class _RunPictures:
    def __init__(self, files: Sequence[Path], episode: RecordedEpisode) -> None:
        self._files, self._episode = files, episode

    def read(self, camera: str, rows: Sequence[int]) -> list[U8]:
        """See `ReadPictures`."""
        name = camera.removeprefix(IMAGES)
        wanted = [self._episode.rows[row].images[name] for row in rows]
        found: dict[int, U8] = {}
        decoder = RecordDecoder()
        for path in self._files:
            for record in read_records(path, decoder.definitions):
                if camera_of(record.topic) == name and (stamp := stamp_of(record.data)) in wanted:
                    found[stamp] = pixels_of(decoder.decode(record), record.type)
        if missing := [stamp for stamp in wanted if stamp not in found]:
            raise InvalidInputError(
                f"{len(missing)} images of camera {name!r} are missing in the run."
            )
        return [found[stamp] for stamp in wanted]
