"""Recorded messages, decoded without ROS."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from rn_recorder_runs.files import Record, read_records
from rn_recorder_runs.schemas import ROS_2, definition

CAMERA = "camera"


@dataclass(frozen=True, slots=True)
class Decoded:
    """A message and its fields; `record` contains times and topic."""

    record: Record
    message: Any


@dataclass(frozen=True, slots=True)
class TopicCounts:
    """Content of one topic in a run.

    Attributes:
        lost: messages missing by the publisher's count; None for several publishers, or without a
            count.
        note: why its messages cannot be decoded, or only by different definitions.
    """

    type: str
    messages: int
    bytes: int
    first_ns: int
    last_ns: int
    lost: int | None
    note: str = ""


class RecordDecoder:
    """Decodes records with the definitions in their file: each with its own, also where files, or
    topics of a file, define a type differently. Those of files without definitions are decoded with
    the installed ones.
    """

    def __init__(self) -> None:
        self.definitions: dict[str, str] = {}
        self._decoders: dict[tuple[str, str | None], Callable[[bytes], object]] = {}

    def decode(self, record: Record) -> Any:
        """Decode the message of a record. Raises ValueError if it cannot be decoded."""
        key = (record.type, record.definition)
        try:
            decoder = self._decoders.get(key)
            if decoder is None:
                decoder = self._decoders[key] = self._decoder(record)
            return decoder(record.data)
        except Exception as error:  # of mcap_ros2, whose parts have no common base
            raise ValueError(
                f"a message of {record.topic} ({record.type}) cannot be decoded: {error}"
            ) from error

    def _decoder(self, record: Record) -> Callable[[bytes], object]:
        text = record.definition
        if text is None:
            text = self.definitions.get(record.type) or definition(record.type)
        if not text:
            raise ValueError("its definition is not of ROS 2")
        schema = Schema(id=1, name=record.type, encoding=ROS_2, data=text.encode())
        found = DecoderFactory().decoder_for("cdr", schema)
        if found is None:
            raise ValueError("its definition is not of ROS 2")
        return found


def iterate(
    files: Sequence[Path], wanted: Callable[[str], bool], decode: bool = True
) -> Iterator[Decoded]:
    """Yield the messages of those topics, file after file, in the order of writing."""
    decoder = RecordDecoder()
    for path in files:
        for record in read_records(path, decoder.definitions):
            if wanted(record.topic):
                yield Decoded(record, decoder.decode(record) if decode else None)


def count_topics(
    files: Sequence[Path], damage: dict[Path, list[str]] | None = None
) -> dict[str, TopicCounts]:
    """Number of messages by topic, and of missing ones by the publishers' own counts.

    `damage` gets what is wrong with a file, by file.
    """
    messages: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    missing: Counter[str] = Counter()
    times: dict[str, tuple[int, int]] = {}
    types: dict[str, str] = {}
    definitions: dict[str, set[str | None]] = {}
    newest: dict[str, int] = {}
    uncounted: set[str] = set()
    for path in files:
        found: list[str] = [] if damage is None else damage.setdefault(path, [])
        for record in read_records(path, damage=found):
            topic, sequence = record.topic, record.sequence
            messages[topic] += 1
            sizes[topic] += len(record.data)
            types.setdefault(topic, record.type)
            definitions.setdefault(record.type, set()).add(record.definition)
            first, last = times.get(topic, (record.log_ns, record.log_ns))
            times[topic] = (min(first, record.log_ns), max(last, record.log_ns))
            before = newest.get(topic)
            newest[topic] = sequence
            if sequence == 0 or (before is not None and 1 < sequence <= before):
                uncounted.add(topic)  # several publishers count separately
            elif before is not None and sequence > before:
                missing[topic] += sequence - before - 1
    return {
        topic: TopicCounts(
            types[topic],
            messages[topic],
            sizes[topic],
            *times[topic],
            None if topic in uncounted else missing[topic],
            _note(definitions[types[topic]]),
        )
        for topic in sorted(messages)
    }


def _note(definitions: set[str | None]) -> str:
    if "" in definitions:
        return "not of ROS 2, is not decoded"
    return f"one of {len(definitions)} definitions of this type" if len(definitions) > 1 else ""


def camera_of(topic: str) -> str:
    """Camera of an image topic ("/ns/camera/<name>/image" or its ".../compressed"); empty for
    others.
    """
    parts = topic.removesuffix("/compressed").split("/")
    return parts[-2] if len(parts) >= 3 and parts[-1] == "image" and parts[-3] == CAMERA else ""


def ends_with(topic: str, names: Collection[str]) -> bool:
    """True if the topic's last name is one of these."""
    return topic.rpartition("/")[2] in names
