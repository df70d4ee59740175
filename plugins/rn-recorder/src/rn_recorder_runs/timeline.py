"""Access to a run by time: messages are read from its files on demand.

Small messages are kept in memory. Large ones, such as images, stay in the files: a chunk is read
again when one of its messages is needed. Files without an index, such as those being written now,
are read as well.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from rn_recorder_runs.files import DAMAGE, Record, read_about, whole_records
from rn_recorder_runs.reading import RecordDecoder
from roboneuron import InvalidInputError

_LARGE_BYTES = 8192
"""Size from which messages stay on disk: images do, and an hour of everything else fits into
memory.
"""
_CHUNKS = 8
"""Number of unpacked chunks in memory, of about a megabyte each: playing reads them in order."""
_Place = tuple[Path, int, int]
"""File, position of the record with the message, and its index in the record."""


class _TopicTrack:
    """The messages of one topic, oldest first."""

    def __init__(self, type_name: str) -> None:
        self.type = type_name
        self.times_ns: list[int] = []
        self.kept: list[tuple[int, int, bytes | _Place]] = []

    def add(self, log_ns: int, publish_ns: int, sequence: int, data: bytes | _Place) -> None:
        index = len(self.times_ns)
        if index and log_ns < self.times_ns[-1]:  # a publisher's message that was recorded late
            index = bisect_right(self.times_ns, log_ns)
        self.times_ns.insert(index, log_ns)
        self.kept.insert(index, (publish_ns, sequence, data))


class Timeline:
    """Reads the files once, without pixels. Used from one thread at a time.

    Args:
        files: MCAP files of one run.

    Attributes:
        about: metadata of the run from the first file.
        begin_ns, end_ns: times of the first and the last message [ns].

    Raises:
        InvalidInputError: there is no message in them.
        OSError: they cannot be read.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.about = read_about(files[0]) if files else {}
        self._tracks: dict[str, _TopicTrack] = {}
        self._decoder = RecordDecoder()
        self._unpacked: OrderedDict[tuple[Path, int], list[Message]] = OrderedDict()
        for path in files:
            self._read(path)
        if not self._tracks:
            raise InvalidInputError("The run holds no messages.")
        self.begin_ns = min(track.times_ns[0] for track in self._tracks.values())
        self.end_ns = max(track.times_ns[-1] for track in self._tracks.values())

    @property
    def topics(self) -> dict[str, str]:
        """Type by topic."""
        return {topic: track.type for topic, track in self._tracks.items()}

    def newest(self, topic: str, at_ns: int) -> Record | None:
        """The newest message of a topic recorded until then; None if there was none yet."""
        track = self._tracks.get(topic)
        index = bisect_right(track.times_ns, at_ns) if track is not None else 0
        return self._record(topic, index - 1) if index else None

    def between(self, topic: str, after_ns: int, until_ns: int) -> Iterator[Record]:
        """Messages of a topic recorded after one time and until another, oldest first."""
        track = self._tracks.get(topic)
        if track is not None:
            first = bisect_right(track.times_ns, after_ns)
            for index in range(first, bisect_right(track.times_ns, until_ns)):
                yield self._record(topic, index)

    def decode(self, record: Record) -> Any:
        """Decode the message of a record. Raises ValueError if its definition cannot be read."""
        return self._decoder.decode(record)

    def _record(self, topic: str, index: int) -> Record:
        track = self._tracks[topic]
        publish_ns, sequence, data = track.kept[index]
        if not isinstance(data, bytes):
            path, position, number = data
            data = self._messages(path, position)[number].data
        return Record(topic, track.type, track.times_ns[index], publish_ns, sequence, data)

    def _messages(self, path: Path, position: int) -> list[Message]:
        """The messages of the record at a position of a file, cached."""
        found = self._unpacked.get((path, position))
        if found is None:
            with path.open("rb") as file:
                file.seek(position)
                found = _messages_of(
                    next(StreamReader(file, skip_magic=True, emit_chunks=True).records)
                )
            self._unpacked[path, position] = found
            if len(self._unpacked) > _CHUNKS:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end((path, position))
        return found

    def _read(self, path: Path) -> None:
        schemas: dict[int, str] = {}
        channels: dict[int, Channel] = {}
        with path.open("rb", buffering=1 << 20) as file:
            position = file.tell()
            for entry in whole_records(file, emit_chunks=True):
                try:
                    parts = breakup_chunk(entry) if isinstance(entry, Chunk) else [entry]
                except DAMAGE:
                    return
                self._add(parts, (path, position), schemas, channels)
                position = file.tell()

    def _add(
        self,
        parts: Sequence[McapRecord],
        place: tuple[Path, int],
        schemas: dict[int, str],
        channels: dict[int, Channel],
    ) -> None:
        """Add the messages among the records at one position, with their schemas and channels."""
        number = 0
        for part in parts:
            if isinstance(part, Schema):
                schemas[part.id] = part.name
                self._decoder.definitions[part.name] = part.data.decode()
            elif isinstance(part, Channel):
                channels[part.id] = part
            elif isinstance(part, Message):
                channel = channels[part.channel_id]
                track = self._tracks.get(channel.topic)
                if track is None:
                    track = self._tracks[channel.topic] = _TopicTrack(
                        schemas.get(channel.schema_id, "")
                    )
                data = part.data if len(part.data) < _LARGE_BYTES else (*place, number)
                track.add(part.log_time, part.publish_time, part.sequence, data)
                number += 1


def _messages_of(entry: McapRecord) -> list[Message]:
    parts = breakup_chunk(entry) if isinstance(entry, Chunk) else [entry]
    return [part for part in parts if isinstance(part, Message)]
