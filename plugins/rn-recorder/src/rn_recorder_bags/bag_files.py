"""Bags of ROS 2 as rosbag2 and others write them, MCAP and SQLite, read in the order of writing.

Source of the layouts: rosbag2 of ROS 2 Jazzy, `metadata.yaml` of version 9 and the tables of
rosbag2_storage_sqlite3 of version 4; compression of files and of messages by rosbag2_compression.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from zstandard import ZstdDecompressor, ZstdError

from rn_recorder_runs.files import Record, read_records
from rn_recorder_runs.schemas import to_definition
from roboneuron import ForeignDataError, InvalidInputError, foreign

METADATA = "metadata.yaml"
_INFORMATION = "rosbag2_bagfile_information"
_STORAGES = (".mcap", ".db3")
_COMPRESSED = ".zstd"
_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of Zstandard; those of a CDR message are 0 and 0 to 11."""
_MOST_FILES = 100_000
_MOST_BYTES = 1 << 26
"""Largest metadata.yaml; a file in it has 200 bytes."""


@dataclass(frozen=True, slots=True)
class Bag:
    """One recording; `files` in the order of writing."""

    name: str
    files: tuple[Path, ...]


def find_bag(path: Path) -> Bag:
    """Find the files of a bag.

    Args:
        path: a folder, with or without metadata.yaml, or a single file.

    Raises:
        InvalidInputError: it is no bag, or its metadata.yaml cannot be read.
    """
    if path.is_file() and is_storage(path):
        return Bag(path.name, (path,))
    if (path / METADATA).is_file():
        return Bag(path.name, _listed(path))
    if path.is_dir() and (files := sorted(filter(is_storage, path.iterdir()), key=_in_order)):
        return Bag(path.name, tuple(files))
    raise InvalidInputError(
        f"{path} is no bag of ROS 2.",
        hint=f"Name a folder with {METADATA}, or a file {' or '.join(_STORAGES)}.",
    )


def is_storage(path: Path) -> bool:
    """True for a file of a bag by its name."""
    return Path(path.name.removesuffix(_COMPRESSED)).suffix in _STORAGES


def _in_order(path: Path) -> list[int | str]:
    """The name with its numbers as numbers: rosbag2 counts files from 0."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


def _listed(folder: Path) -> tuple[Path, ...]:
    try:
        text = foreign.read_text(folder / METADATA, most_bytes=_MOST_BYTES)
        told = YAML(typ="safe", pure=True).load(text)
        names = foreign.field(foreign.field(told, _INFORMATION), "relative_file_paths")
        # bags of ROS 2 Foxy and before name the folder too
        return tuple(
            folder / PurePosixPath(foreign.text(name, "a file's name", 4096)).name
            for name in foreign.items(names, "relative_file_paths", most=_MOST_FILES, least=1)
        )
    except (ForeignDataError, YAMLError, RecursionError) as error:
        raise InvalidInputError(
            f"{folder / METADATA} cannot be read: {' '.join(str(error).split())[:200]}",
            hint="Without this file the folder is read as well: rename it.",
        ) from error


def read_bag(bag: Bag, damage: list[str]) -> Iterator[Record]:
    """Yield the messages of a bag in the order of writing, each file up to its first damage.

    Args:
        bag: its files.
        damage: gets what is missing or damaged.
    """
    for path in bag.files:
        found: list[str] = []
        try:
            with _plain(path) as file:
                is_mcap = file.suffix == ".mcap"
                records = read_records(file, damage=found) if is_mcap else _read_sqlite(file)
                for record in records:
                    yield _plain_record(record)
        except (OSError, sqlite3.Error, ZstdError) as error:
            found.append(str(getattr(error, "strerror", None) or error))
        damage += [f"{path.name} is read up to its damage: {why}" for why in found]


@contextmanager
def _plain(path: Path) -> Iterator[Path]:
    """Yield the file without compression."""
    if path.suffix != _COMPRESSED:
        yield path
        return
    with TemporaryDirectory() as folder:
        plain = Path(folder) / path.name.removesuffix(_COMPRESSED)
        with path.open("rb") as compressed, plain.open("wb") as file:
            ZstdDecompressor().copy_stream(compressed, file)
        yield plain


def _plain_record(record: Record) -> Record:
    if not record.data.startswith(_MAGIC):
        return record
    return replace(record, data=ZstdDecompressor().decompressobj().decompress(record.data))


def _read_sqlite(path: Path) -> Iterator[Record]:
    """As `read_records`. Raises sqlite3.Error, FileNotFoundError."""
    path.stat()  # an error of SQLite does not tell that it is missing
    # a crashed recorder leaves messages in a log, which SQLite merges only if it may lock
    mode = "mode=ro" if path.with_name(f"{path.name}-wal").exists() else "immutable=1"
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)) as base:
        definitions = _definitions(base)
        topics: dict[object, tuple[str, str, str | None]] = {}
        for number, name, kind, form in base.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            topics[number] = (str(name), str(kind), definitions.get(kind) if form == "cdr" else "")
        rows = base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id")
        for number, at_ns, data in rows:
            if number in topics and isinstance(at_ns, int) and isinstance(data, bytes):
                topic, kind, definition = topics[number]
                yield Record(topic, kind, at_ns, at_ns, 0, data, definition)


def _definitions(base: sqlite3.Connection) -> dict[str, str]:
    """Definition by type; none of a bag before ROS 2 Iron."""
    tables: Sequence[tuple[object, ...]] = base.execute(
        "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'"
    ).fetchall()
    if not tables:
        return {}
    rows = base.execute(
        "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    )
    return {
        kind: text
        for kind, encoding, schema in rows
        if (text := to_definition(str(kind), str(encoding), str(schema)))
    }
