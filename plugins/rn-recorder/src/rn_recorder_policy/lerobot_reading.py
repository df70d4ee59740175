"""One episode of a LeRobot data set, v2.0, v2.1 or v3.0, read without lerobot.

Source of the layouts: lerobot 0.3.3 (v2.1) and 0.6.1 (v3.0), `datasets/utils.py`, and data sets
written by them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.demonstration import ACTION, INTERVENTION, Column, Demonstration
from rn_recorder_policy.pictures import decode_image, read_video_frames
from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    MissingDependencyError,
    foreign,
    install_command,
)

U8 = NDArray[np.uint8]
INFO = Path("meta") / "info.json"
_OLD, _NEW = ("v2.0", "v2.1"), "v3."
_CHUNK_SIZE = 1000
_MOST_BYTES = 1 << 24
_NUMBERS = ("float32", "float64", "int32", "int64", "bool")


class _Feature(TypedDict):
    """A column, as meta/info.json describes it."""

    dtype: str
    names: NotRequired[object]


class _Info(TypedDict):
    """Used parts of meta/info.json."""

    codebase_version: NotRequired[str]
    fps: float
    features: dict[str, _Feature]
    data_path: str
    video_path: str
    chunks_size: NotRequired[int]
    total_episodes: NotRequired[int]


def read_lerobot(directory: Path, episode: int) -> Demonstration:
    """Read an episode of the data set in a folder.

    Raises:
        InvalidInputError: the version is another one, there is no such episode, or a file is
            missing or damaged.
        MissingDependencyError: pyarrow is not installed.
    """
    info = _json(directory / INFO)
    version = str(info.get("codebase_version"))
    if version not in _OLD and not version.startswith(_NEW):
        raise InvalidInputError(
            f"The data set {directory} has the version {version!r}; read are "
            f"{', '.join(_OLD)} and {_NEW}x.",
            hint="Convert it with the scripts of lerobot.",
        )
    is_old = version in _OLD
    entry = (_old_entry if is_old else _new_entry)(directory, info, episode)
    return _Episode(directory, info, episode, entry, is_old).demonstration()


def episode_count(directory: Path) -> int:
    """Number of episodes of a data set. Raises InvalidInputError for another folder."""
    return int(_json(directory / INFO).get("total_episodes", 0))


class _Episode:
    """Files of one episode."""

    def __init__(
        self,
        directory: Path,
        info: _Info,
        number: int,
        entry: Mapping[str, Any],
        is_old: bool,
    ) -> None:
        self._directory, self._info, self._number = directory, info, number
        self._entry, self._is_old = entry, is_old
        self._fps = float(info["fps"])
        self._features = info["features"]
        path = directory / info["data_path"].format(**self._place("data"))
        self._table = _read_table(path, [("episode_index", "=", number)])
        if not self._table.num_rows:
            raise InvalidInputError(f"{path} holds no rows of episode {number}.")

    def demonstration(self) -> Demonstration:
        """The read episode."""
        columns = {
            name: Column(names=_names(feature.get("names")), values=self._numbers(name))
            for name, feature in self._features.items()
            if feature["dtype"] in _NUMBERS
            and (name.startswith((ACTION, "observation.")) or name == INTERVENTION)
            and name in self._table.column_names
        }
        tasks = self._entry.get("tasks") or [""]
        return Demonstration(
            source=f"episode {self._number} of {self._directory}",
            fps=self._fps,
            instruction=str(tasks[0]),
            columns=columns,
            cameras=tuple(n for n, f in self._features.items() if f["dtype"] in ("video", "image")),
            read_pictures=self.read_pictures,
        )

    def read_pictures(self, camera: str, rows: Sequence[int]) -> list[U8]:
        """See `ReadPictures`."""
        if self._features[camera]["dtype"] == "image":
            cells = self._table.column(camera)
            return [self._image(cells[row].as_py(), camera) for row in rows]
        begin_s = float(self._entry.get(f"videos/{camera}/from_timestamp", 0.0))
        path = self._info["video_path"].format(video_key=camera, **self._place(f"videos/{camera}"))
        times = self._table.column("timestamp").to_pylist()
        return read_video_frames(
            self._directory / path, [begin_s + times[row] for row in rows], self._fps
        )

    def _image(self, cell: object, camera: str) -> U8:
        place = f"{camera} of episode {self._number}"
        if isinstance(cell, Mapping) and cell.get("bytes"):
            return decode_image(cell["bytes"], place)
        if isinstance(cell, Mapping) and cell.get("path"):
            path = self._directory / str(cell["path"])
            if path.is_file():
                return decode_image(path.read_bytes(), place)
        raise InvalidInputError(f"An image of {place} is missing.")

    def _place(self, what: str) -> dict[str, int]:
        """Values for the path templates."""
        if self._is_old:
            chunk = self._number // int(self._info.get("chunks_size", _CHUNK_SIZE))
            return {"episode_chunk": chunk, "episode_index": self._number}
        return {
            "chunk_index": int(self._entry[f"{what}/chunk_index"]),
            "file_index": int(self._entry[f"{what}/file_index"]),
        }

    def _numbers(self, name: str) -> NDArray[np.float64]:
        values = np.array(self._table.column(name).to_pylist(), dtype=np.float64)
        return values.reshape(len(values), -1)


def _names(names: object) -> tuple[str, ...] | None:
    """Names in the formats of files of different age: a list, or lists by group."""
    if isinstance(names, Mapping):
        return tuple(name for part in names.values() for name in _names(part) or ())
    if isinstance(names, str):
        return (names,)
    if isinstance(names, Sequence):
        return tuple(name for part in names for name in _names(part) or ())
    return None


def _old_entry(directory: Path, info: _Info, episode: int) -> Mapping[str, Any]:
    path = directory / "meta" / "episodes.jsonl"
    for entry in _json_lines(path):
        if entry.get("episode_index") == episode:
            return entry
    raise _no_such(directory, info, episode)


def _new_entry(directory: Path, info: _Info, episode: int) -> Mapping[str, Any]:
    for path in sorted((directory / "meta" / "episodes").glob("**/*.parquet")):
        found = _read_table(path, [("episode_index", "=", episode)])
        if found.num_rows:
            kept = [name for name in found.column_names if not name.startswith("stats/")]
            entry: Mapping[str, Any] = found.select(kept).to_pylist()[0]
            return entry
    raise _no_such(directory, info, episode)


def _no_such(directory: Path, info: _Info, episode: int) -> InvalidInputError:
    return InvalidInputError(
        f"The data set {directory} has no episode {episode}.",
        hint=f"meta/info.json tells of {info.get('total_episodes', '?')}, counted from 0.",
    )


def _read_table(path: Path, filters: list[tuple[str, str, int]]) -> Any:
    """Read a table with pyarrow. Raises InvalidInputError, MissingDependencyError."""
    try:
        import pyarrow as pa  # heavy
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingDependencyError(
            "Data sets need pyarrow.",
            hint=f"Run: {install_command('rn-recorder[export]')}.",
        ) from error
    try:
        return pq.read_table(path, filters=filters)
    except (OSError, pa.ArrowException) as error:
        raise InvalidInputError(
            f"{path} cannot be read: {error}.", hint="Is the data set downloaded completely?"
        ) from error


def _json(path: Path) -> _Info:
    try:
        read: _Info = foreign.read_json(path, most_bytes=_MOST_BYTES, has_constants=True)
    except (OSError, ForeignDataError) as error:
        raise InvalidInputError(f"{path} cannot be read: {error}.") from error
    return read


def _json_lines(path: Path) -> Iterator[dict[str, Any]]:
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.strip():
                yield foreign.decode_json(line, path.name, has_constants=True)
    except (OSError, ValueError, ForeignDataError) as error:
        raise InvalidInputError(f"{path} cannot be read: {error}.") from error
