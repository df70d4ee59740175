"""One pass over a bag: its numbers, and when which picture came; messages that are bad are left out
and counted.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from rn_recorder_bags.bag_files import Bag, read_bag
from rn_recorder_bags.mapping import BagMapping
from rn_recorder_bags.samples import TRAJECTORY, U8, Pictures, field_of, numbers_of, stamp_of
from rn_recorder_runs.files import Record
from rn_recorder_runs.reading import RecordDecoder
from roboneuron import InvalidInputError

EMPTY = "std_msgs/msg/Empty"
S_NS = 1_000_000_000
V = TypeVar("V")


@dataclass(slots=True)
class Track(Generic[V]):
    """Samples in the order of their times [ns]."""

    times_ns: list[int] = field(default_factory=list)
    values: list[V] = field(default_factory=list)

    def add(self, at_ns: int, value: V) -> None:
        """Add a sample, behind those of the same time."""
        place = len(self.times_ns)
        if place and at_ns < self.times_ns[-1]:
            place = bisect_right(self.times_ns, at_ns)
        self.times_ns.insert(place, at_ns)
        self.values.insert(place, value)

    def forget(self, after_ns: int) -> None:
        """Remove the samples after a time."""
        place = bisect_right(self.times_ns, after_ns)
        del self.times_ns[place:], self.values[place:]


@dataclass(frozen=True, slots=True)
class SeenPicture:
    """A picture of a bag: the number of its message, and its shape (H, W, 3)."""

    number: int
    shape: tuple[int, ...]


def _tracks() -> defaultdict[str, Track[Any]]:
    return defaultdict(Track)


@dataclass(slots=True)
class ClockSpan:
    """Part of a bag in which no clock goes back.

    Attributes:
        state, action: numbers by name in the data set.
        pictures: `SeenPicture` by camera.
        marks: values of the topic that cuts episodes; None for messages without one.
        acts: messages of the action's topics.
        leaps: begin and end [ns] of pauses by one clock that another one contradicts.
    """

    state: defaultdict[str, Track[float]] = field(default_factory=_tracks)
    action: defaultdict[str, Track[float]] = field(default_factory=_tracks)
    pictures: defaultdict[str, Track[SeenPicture]] = field(default_factory=_tracks)
    marks: Track[object] = field(default_factory=Track)
    acts: Track[None] = field(default_factory=Track)
    leaps: list[tuple[int, int]] = field(default_factory=list)

    @property
    def extent_ns(self) -> tuple[int, int]:
        """Times of the first and the last sample; there is one."""
        ends = [(track.times_ns[0], track.times_ns[-1]) for track in self._used()]
        return min(first for first, _ in ends), max(last for _, last in ends)

    @property
    def is_empty(self) -> bool:
        """True without a sample."""
        return not self._used()

    def _used(self) -> list[Track[Any]]:
        tracks: list[Track[Any]] = [*self.state.values(), *self.action.values()]
        tracks += [*self.pictures.values(), self.marks]
        return [track for track in tracks if track.times_ns]


@dataclass(slots=True)
class BagScan:
    """What a bag holds.

    Attributes:
        begin_ns: time of its first mapped message.
        cameras: those with a picture.
        left_out: a sentence for each topic with bad messages, jump of a clock, and damaged file.
    """

    bag: Bag
    begin_ns: int
    spans: list[ClockSpan]
    cameras: tuple[str, ...]
    left_out: list[str]


def scan(bag: Bag, mapping: BagMapping) -> BagScan:
    """Read a bag.

    Raises:
        InvalidInputError: a number of the state or the action never came.
        MissingDependencyError: PyAV is not installed, for videos.
    """
    damage: list[str] = []
    scanner = _Scanner(mapping)
    for number, record in enumerate(read_bag(bag, damage)):
        scanner.take(number, record)
    scanner.finish()
    spans = [span for span in scanner.spans if not span.is_empty]
    for part, sources in (("state", mapping.state), ("action", mapping.actions)):
        for source in sources:
            for theirs, name in source.values.items():
                if not any(name in getattr(span, part) for span in spans):
                    why = "; ".join([*scanner.complaints(), *damage])
                    raise InvalidInputError(
                        f"{source.topic} never gives {theirs} ({name}){why and f': {why}'}"
                    )
    seen = [camera for camera in mapping.cameras if any(camera in s.pictures for s in spans)]
    missing = [
        f"{source.topic} (camera {camera!r}) has no picture"
        for camera, source in mapping.cameras.items()
        if camera not in seen
    ]
    left_out = [*damage, *scanner.jumps, *scanner.complaints(), *missing]
    return BagScan(bag, scanner.begin_ns or 0, spans, tuple(seen), left_out)


class _Scanner:
    def __init__(self, mapping: BagMapping) -> None:
        self._mapping = mapping
        self._decoder = RecordDecoder()
        self._jump_ns = round(mapping.jump_s * S_NS)
        self._pause_ns = round(mapping.max_age_s * S_NS)
        self._cuts = mapping.episodes
        self._cameras = {source.topic: camera for camera, source in mapping.cameras.items()}
        self._decoders = {topic: Pictures(finds_losses=True) for topic in self._cameras}
        self._waiting: dict[tuple[str, int], tuple[ClockSpan, int]] = {}
        self._topics = {source.topic for source in (*mapping.state, *mapping.actions)}
        self._topics |= set(self._cameras)
        if self._cuts is not None and self._cuts.topic is not None:
            self._topics.add(self._cuts.topic)
        self._clocks: dict[str, tuple[int, int | None]] = {}
        self._bad: dict[str, list[str]] = {}
        self.begin_ns: int | None = None
        self.spans = [ClockSpan()]
        self.jumps: list[str] = []

    def take(self, number: int, record: Record) -> None:
        """Take the message with that number in the bag."""
        if record.topic not in self._topics:
            return
        try:
            # its definition is the empty text
            message = self._decoder.decode(record) if record.type != EMPTY else None
            at_ns = self._time(record, stamp_of(message))
            self._take_numbers(record, message, at_ns)
            if self._cuts is not None and record.topic == self._cuts.topic:
                mark = None if message is None else field_of(message, self._cuts.field)
                self.spans[-1].marks.add(at_ns, mark)
            if record.topic in self._cameras:
                self._waiting[record.topic, number] = self.spans[-1], at_ns
                decoder = self._decoders[record.topic]
                self._keep(record.topic, decoder.decode(number, message, record.type))
        except (ValueError, InvalidInputError) as error:
            self._waiting.pop((record.topic, number), None)
            if record.topic in self._decoders:
                self._decoders[record.topic].lose()
            self._complain(record.topic, str(error))

    def finish(self) -> None:
        """Take the pictures that the decoders still hold."""
        for topic, decoder in self._decoders.items():
            self._keep(topic, decoder.finish())
        for topic, _ in self._waiting:
            self._complain(topic, "a video frame is not whole")

    def complaints(self) -> list[str]:
        """A sentence for each topic with messages that were left out."""
        return [
            f"{len(reasons)} messages of {topic} are left out, the first one because {reasons[0]}"
            for topic, reasons in self._bad.items()
        ]

    def _time(self, record: Record, stamp_ns: int | None) -> int:
        """Time of a message by the chosen clock; begins a span if that went back."""
        is_stamped = self._mapping.time == "header" and stamp_ns is not None
        if is_stamped and not stamp_ns:
            raise InvalidInputError("its stamp is 0")
        times_ns = (stamp_ns, record.log_ns) if is_stamped else (record.log_ns, stamp_ns or None)
        at_ns, other_ns = times_ns
        assert at_ns is not None
        self.begin_ns = at_ns if self.begin_ns is None else self.begin_ns
        last_ns, last_other_ns = self._clocks.get(record.topic, (at_ns, other_ns))
        step_ns = at_ns - last_ns
        if -step_ns >= self._jump_ns:
            self.jumps.append(
                f"a clock jumps back by {-step_ns / S_NS:.3f} s at "
                f"{(last_ns - self.begin_ns) / S_NS:.2f} s ({record.topic})"
            )
            self.spans.append(ClockSpan())
            self._clocks.clear()
        elif step_ns > self._pause_ns and other_ns is not None and last_other_ns is not None:
            is_leap = abs(step_ns - (other_ns - last_other_ns)) >= self._jump_ns
            self.spans[-1].leaps += [(last_ns, at_ns)] if is_leap else []
        newest_ns = at_ns if record.topic not in self._clocks else max(at_ns, last_ns)
        self._clocks[record.topic] = newest_ns, other_ns
        return at_ns

    def _take_numbers(self, record: Record, message: Any, at_ns: int) -> None:
        span = self.spans[-1]
        parts = ((self._mapping.state, span.state), (self._mapping.actions, span.action))
        for sources, tracks in parts:
            for source in sources:
                if source.topic != record.topic:
                    continue
                for after_ns, values in list(numbers_of(message, record.type, source.values)):
                    for name, value in values.items():
                        if record.type == TRAJECTORY and not after_ns:  # it ends the one before
                            tracks[name].forget(at_ns)
                        tracks[name].add(at_ns + after_ns, value)
        if any(source.topic == record.topic for source in self._mapping.actions):
            span.acts.add(at_ns, None)

    def _keep(self, topic: str, pictures: Sequence[tuple[int, U8]]) -> None:
        for number, pixels in pictures:
            span, at_ns = self._waiting.pop((topic, number))
            seen = SeenPicture(number, pixels.shape)
            span.pictures[self._cameras[topic]].add(at_ns, seen)

    def _complain(self, topic: str, why: str) -> None:
        self._bad.setdefault(topic, []).append(" ".join(why.split()).rstrip(".")[:200])
