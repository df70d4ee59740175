"""Where the episodes of a bag begin and end: by the values of a topic, by silence, or one a bag."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from rn_recorder_bags.mapping import BagMapping, EpisodeCuts
from rn_recorder_bags.scanning import S_NS, BagScan, ClockSpan


@dataclass(frozen=True, slots=True)
class Window:
    """Time of one episode [ns]; `is_marked` if the bag says that it begins there."""

    begin_ns: int
    end_ns: int
    instruction: str
    is_marked: bool = False


def windows_of(scan: BagScan, mapping: BagMapping) -> list[list[Window]]:
    """The episodes of each span; one that is open when a clock jumps back goes on after it."""
    cuts = mapping.episodes
    fallback = mapping.instruction or scan.bag.name
    if cuts is not None and cuts.topic is not None:
        marker = _Marker(cuts, fallback)
        return [list(marker.windows(span)) for span in scan.spans]
    if cuts is not None and cuts.silence_s is not None:
        silence_ns = round(cuts.silence_s * S_NS)
        return [list(_between_silences(span, silence_ns, fallback)) for span in scan.spans]
    return [[Window(*span.extent_ns, fallback)] for span in scan.spans]


def _between_silences(span: ClockSpan, silence_ns: int, instruction: str) -> Iterator[Window]:
    times_ns = span.acts.times_ns
    ends = [place for place, (a, b) in enumerate(pairwise(times_ns), 1) if b - a > silence_ns]
    for first, end in pairwise([0, *ends, len(times_ns)]):
        if end > first:
            yield Window(times_ns[first], times_ns[end - 1], instruction)


class _Marker:
    """Follows the values of the topic that cuts episodes."""

    def __init__(self, cuts: EpisodeCuts, instruction: str) -> None:
        self._cuts, self._instruction = cuts, instruction
        self._open: str | None = None
        self._last: object = None

    def windows(self, span: ClockSpan) -> Iterator[Window]:
        """The episodes of a span."""
        begin_ns, end_ns = span.extent_ns
        is_marked = False
        for at_ns, value in zip(span.marks.times_ns, span.marks.values, strict=True):
            if value is not None and value == self._last:
                continue  # a topic may tell its value again and again
            self._last = value
            if not (self._begins(value) or self._ends(value)):
                continue
            if self._open is not None:
                yield Window(begin_ns, at_ns, self._open, is_marked)
            begin_ns, is_marked = at_ns, True
            self._open = None if self._ends(value) else self._instruction_of(value)
        if self._open is not None:
            yield Window(begin_ns, end_ns, self._open, is_marked)

    def _ends(self, value: object) -> bool:
        if self._cuts.end is not None:
            return value == self._cuts.end
        return value is not None and not value

    def _begins(self, value: object) -> bool:
        return value == self._cuts.begin if self._cuts.begin is not None else not self._ends(value)

    def _instruction_of(self, value: object) -> str:
        is_told = isinstance(value, str) and self._cuts.begin is None
        return str(value) if is_told else self._instruction
