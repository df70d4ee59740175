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
    """

    type: str
    messages: int
    bytes: int
    first_ns: int
    last_ns: int
    lost: int | None


class RecordDecoder:
    """Decodes records with the definitions in their file."""

    def __init__(self) -> None:
        self.definitions: dict[str, str] = {}
        self._decoders: dict[str, Callable[[bytes], object]] = {}

    def decode(self, record: Record) -> Any:
        """Decode the message of a record. Raises ValueError if its definition cannot be read."""
        decoder = self._decoders.get(record.type)
        if decoder is None:
            schema = Schema(
                id=1,
                name=record.type,
                encoding="ros2msg",
                data=self.definitions[record.type].encode(),
            )
            found = DecoderFactory().decoder_for("cdr", schema)
            if found is None:
                raise ValueError(f"messages of type {record.type} cannot be decoded")
            decoder = self._decoders[record.type] = found
        return decoder(record.data)


def iterate(
    files: Sequence[Path], wanted: Callable[[str], bool], decode: bool = True
) -> Iterator[Decoded]:
    """Yield the messages of those topics, file after file, in the order of writing."""
    decoder = RecordDecoder()
    for path in files:
        for record in read_records(path, decoder.definitions):
            if wanted(record.topic):
                yield Decoded(record, decoder.decode(record) if decode else None)


def count_topics(files: Sequence[Path]) -> dict[str, TopicCounts]:
    """Number of messages by topic, and of missing ones by the publishers' own counts."""
    messages: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    missing: Counter[str] = Counter()
    times: dict[str, tuple[int, int]] = {}
    types: dict[str, str] = {}
    newest: dict[str, int] = {}
    uncounted: set[str] = set()
    for path in files:
        for record in read_records(path):
            topic, sequence = record.topic, record.sequence
            messages[topic] += 1
            sizes[topic] += len(record.data)
            types[topic] = record.type
            first, _ = times.get(topic, (record.log_ns, 0))
            times[topic] = (first, record.log_ns)
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
        )
        for topic in sorted(messages)
    }


def camera_of(topic: str) -> str:
    """Camera of an image topic ("/ns/camera/<name>/image" or its ".../compressed"); empty for
    others.
    """
    parts = topic.removesuffix("/compressed").split("/")
    return parts[-2] if len(parts) >= 3 and parts[-1] == "image" and parts[-3] == CAMERA else ""


def ends_with(topic: str, names: Collection[str]) -> bool:
    """True if the topic's last name is one of these."""
    return topic.rpartition("/")[2] in names
