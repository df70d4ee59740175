"""MCAP files with the profile "ros2": a killed writer loses at most half a second, and truncated
files are readable.

Every file is self-contained: it includes the message definitions, the configuration, and units and
frames.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, cast
from zlib import error as ZlibError

from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Channel, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from zstandard import ZstdError

from rn_recorder_runs.action_labels import is_action, label_of, named_values
from rn_recorder_runs.schemas import ROS_2, definition, to_definition
from roboneuron.feature import log_files

CHUNK_BYTES = 1 << 20
FLUSH_S = 0.5
"""Maximum time before a chunk is written, which is the loss of a killed recorder."""
LIBRARY = "rn-recorder"
"""Name of the writer in the files."""
METADATA = "roboneuron"
"""Name of the metadata record with the file's content and configuration."""
LATCHED = "roboneuron.latched"
"""Key of a channel's metadata: every file begins with the newest messages of its topic."""
DAMAGE = (McapError, ZstdError, ZlibError, struct.error, ValueError, EOFError, UnicodeDecodeError)
"""Exceptions of a reader at the end of a truncated file."""
_DAMAGE_OF_OTHERS = (MemoryError, OverflowError, RuntimeError, KeyError, IndexError)
"""Further ones, in files that were changed; RuntimeError is that of LZ4."""
_DAMAGE_OF_INDEX = (*DAMAGE, *_DAMAGE_OF_OTHERS, OSError)
"""Those of an index; OSError is that of an offset before the file."""


@dataclass(frozen=True, slots=True)
class Record:
    """One recorded message.

    Attributes:
        topic, type: absolute topic, type such as "sensor_msgs/msg/Image".
        log_ns: when the recorder received it [ns, wall clock].
        publish_ns: when its publisher sent it [ns]; `log_ns` when unknown.
        sequence: the publisher's own count, from 1; 0 when unknown.
        data: CDR.
        definition: text of the type in the file that it was read from; empty if that is not of ROS
            2; None if it was not read from a file.
    """

    topic: str
    type: str
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes
    definition: str | None = None


class _Unbuffered:
    """Output of the MCAP writer: each chunk goes to the operating system at once, and counts only
    if complete.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        self._size = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._descriptor, rest)
            self._size += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """No effect: nothing is buffered."""

    def close(self) -> None:
        if self._descriptor >= 0:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)


class RunFile:
    """Writes one MCAP file. Used from one thread. Every method may raise OSError.

    Args:
        path: must not exist yet; created without access for others.
        about: strings for the metadata record at the beginning.
        definitions: definition by type, for those not installed here (copied from another file).
        channels: metadata by topic, such as its quality of service; read when the topic first
            occurs.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        definitions: Mapping[str, str] | None = None,
        channels: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        self.path = path
        self.messages = 0
        self.unwritten = 0
        """Number of messages in the chunk in progress, not yet handed to the operating system."""
        self.first_ns = 0
        self.last_ns = 0
        self._definitions = {} if definitions is None else definitions
        self._topics = {} if channels is None else channels
        self._file = _Unbuffered(path)
        self._writer = Writer(
            cast("IO[bytes]", self._file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._channels: dict[tuple[str, str, str, str | None], int] = {}
        self._schemas: dict[tuple[str, str | None], int] = {}
        try:
            self._writer.start(profile="ros2", library=LIBRARY)
            self._writer.add_metadata(METADATA, dict(about))
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError:
            self.abandon()
            with suppress(OSError):
                path.unlink()
            raise

    @property
    def size_bytes(self) -> int:
        """Size handed to the operating system."""
        return self._file.tell()

    def write(self, record: Record) -> None:
        """Add a message. Raises FileNotFoundError if the definition of its type is unknown."""
        # a channel for each control space: its metadata names the values
        label = label_of(record.data) if is_action(record.topic, record.type) else ""
        key = (record.topic, record.type, label, record.definition)
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._register(record, label)
        before = self.size_bytes
        self._writer.add_message(
            channel, record.log_ns, record.data, record.publish_ns, record.sequence & 0xFFFFFFFF
        )
        self.messages += 1
        self.unwritten = self.unwritten + 1 if self.size_bytes == before else 0
        self.first_ns = min(self.first_ns or record.log_ns, record.log_ns)
        self.last_ns = max(self.last_ns, record.log_ns)

    def flush(self) -> None:
        """Write the chunk in progress."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.unwritten = 0

    def attach(self, name: str, media_type: str, data: bytes, at_ns: int) -> None:
        """Add an attachment."""
        self._writer.add_attachment(at_ns, at_ns, name, media_type, data)

    def finish(self) -> None:
        """Write the index and close; the file is closed even if that fails."""
        try:
            self.flush()
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close without an index; flushed data can be read."""
        with suppress(OSError):
            self._file.close()

    def _register(self, record: Record, label: str) -> int:
        key = (record.type, record.definition)  # files may define a type differently
        schema = self._schemas.get(key)
        if schema is None:
            known = record.definition or self._definitions.get(record.type)
            text = known or definition(record.type)
            schema = self._schemas[key] = self._writer.register_schema(
                record.type, ROS_2, text.encode()
            )
        told = {**self._topics.get(record.topic, {}), **named_values(label)}
        return self._writer.register_channel(record.topic, "cdr", schema, told)


def is_finished(path: Path) -> bool:
    """True if the file ends as a complete MCAP file does."""
    try:
        with path.open("rb") as file:
            file.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            return file.read() == MCAP0_MAGIC and file.tell() > 2 * len(MCAP0_MAGIC)
    except OSError:
        return False


def whole_records(
    file: IO[bytes], *, emit_chunks: bool = False, damage: list[str] | None = None
) -> Iterator[McapRecord]:
    """Yield the records of an MCAP file up to its end or the first damage.

    Args:
        file: open for reading.
        emit_chunks: yield chunks; otherwise the records in them.
        damage: gets what is wrong where the file is damaged.
    """
    size = os.fstat(file.fileno()).st_size  # no record is longer, whatever its length says
    records = StreamReader(file, emit_chunks=emit_chunks, record_size_limit=size).records
    while True:
        try:
            record = next(records, None)
        except (*DAMAGE, *_DAMAGE_OF_OTHERS) as error:
            if damage is not None:
                damage.append(_what(error))
            return
        if record is None:
            return
        yield record


def _what(error: Exception) -> str:
    if isinstance(error, (struct.error, EndOfFile)):
        return "it ends within a record"
    return " ".join(str(error).split())[:120] or type(error).__name__


def read_records(
    path: Path,
    definitions: dict[str, str] | None = None,
    metadata: dict[str, dict[str, str]] | None = None,
    damage: list[str] | None = None,
) -> Iterator[Record]:
    """Yield the messages of a file in the order of writing; a truncated end is left out.

    Args:
        path: finished or not.
        definitions: filled with the definition of each type that occurs.
        metadata: filled with the metadata of each topic that occurs.
        damage: gets what is wrong where the file is damaged.

    Raises:
        OSError: it cannot be read.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    texts: dict[int, str] = {}
    with path.open("rb", buffering=1 << 20) as file:
        for entry in whole_records(file, damage=damage):
            if isinstance(entry, Schema):
                schemas[entry.id] = entry
                text = entry.data.decode(errors="replace")
                texts[entry.id] = to_definition(entry.name, entry.encoding, text)
                if definitions is not None:
                    definitions[entry.name] = texts[entry.id]
            elif isinstance(entry, Channel):
                channels[entry.id] = entry
                if metadata is not None:
                    metadata[entry.topic] = dict(entry.metadata)
            elif isinstance(entry, Message):
                channel = channels.get(entry.channel_id)
                if channel is None:
                    continue  # of a damaged file
                name = schemas[channel.schema_id].name if channel.schema_id in schemas else ""
                yield Record(
                    channel.topic,
                    name,
                    entry.log_time,
                    entry.publish_time,
                    entry.sequence,
                    entry.data,
                    texts.get(channel.schema_id, "") if channel.message_encoding == "cdr" else "",
                )


def read_about(path: Path) -> dict[str, str]:
    """Metadata of the file; empty if its beginning is damaged."""
    with path.open("rb") as file:
        for entry in whole_records(file):
            if isinstance(entry, Metadata) and entry.name == METADATA:
                return dict(entry.metadata)
            if isinstance(entry, Message):
                break
    return {}


def read_statistics(path: Path) -> tuple[Statistics | None, dict[int, str]]:
    """Statistics of a finished file from its index, and topic by channel; None without an index.

    Raises:
        FileNotFoundError, PermissionError: it cannot be opened.
    """
    with path.open("rb") as file, suppress(*_DAMAGE_OF_INDEX):
        summary = make_reader(file).get_summary()
        if summary is not None and summary.statistics is not None:
            return summary.statistics, {
                key: channel.topic for key, channel in summary.channels.items()
            }
    return None, {}


def read_attachments(path: Path) -> dict[str, bytes]:
    """Attachments of a finished file, by name; none of a damaged one.

    Raises:
        FileNotFoundError, PermissionError: it cannot be opened.
    """
    with path.open("rb") as file, suppress(*_DAMAGE_OF_INDEX):
        return {entry.name: entry.data for entry in make_reader(file).iter_attachments()}
    return {}


def copy_records(
    sources: list[Path],
    target: Path,
    about: Mapping[str, str],
    *,
    since_ns: int = 0,
    until_ns: int | None = None,
    attachments: Mapping[str, object] | None = None,
    again_ns: int | None = None,
    skipped: set[str] | None = None,
) -> int:
    """Merge several files, oldest first, into one finished file; return the number of messages.

    A message in several files is written once; each file contains the newest of latched topics.
    Latched ones are written whatever their time. `again_ns`: messages before that time [ns] are in
    the first source; later ones may be in several. `skipped` gets the topics that are not of ROS 2,
    which are left out.

    Raises:
        OSError: it cannot be written; the partial file is removed.
    """
    part = target.with_name(f".{target.name}.part")
    part.unlink(missing_ok=True)
    definitions: dict[str, str] = {}
    metadata: dict[str, dict[str, str]] = {}
    file = RunFile(part, about, definitions, metadata)
    written: set[tuple[str, int, int, int, int]] = set()
    skipped = set() if skipped is None else skipped
    try:
        for number, source in enumerate(sources):
            from_ns = since_ns if again_ns is None or not number else again_ns
            with suppress(FileNotFoundError):  # the ring continues meanwhile
                for record in read_records(source, definitions, metadata):
                    if record.definition == "":
                        skipped.add(f"{record.topic} ({record.type}), which is not of ROS 2")
                        continue
                    is_latched = LATCHED in metadata.get(record.topic, {})
                    if until_ns is not None and record.log_ns > until_ns:
                        continue
                    if record.log_ns < from_ns and not is_latched:
                        continue
                    if is_latched or (again_ns is not None and record.log_ns >= again_ns):
                        came_ns = 0 if is_latched else record.log_ns
                        key = (
                            record.topic,
                            came_ns,
                            record.publish_ns,
                            record.sequence,
                            hash(record.data),
                        )
                        if key in written:
                            continue
                        written.add(key)
                    if is_latched:
                        record = replace(record, log_ns=max(record.log_ns, since_ns))
                    file.write(record)
        for name, value in (attachments or {}).items():
            file.attach(
                name, "application/json", json.dumps(value, indent=1).encode(), file.last_ns
            )
        file.finish()
    except BaseException:
        file.abandon()
        part.unlink(missing_ok=True)
        raise
    part.replace(target)
    return file.messages


def write_json(path: Path, value: Mapping[str, object]) -> None:
    """Write a small file atomically."""
    temporary = path.with_name(f".{path.name}.part")
    with open(temporary, "w", encoding="utf-8", opener=log_files.opener) as file:
        json.dump(value, file, indent=1)
    temporary.replace(path)
