"""Rows at one rate from samples at several: each holds the newest samples that are not younger than
the row and not older than their limit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rn_recorder_bags.mapping import NEXT_STATE, BagMapping, NumberSource, TopicSource
from rn_recorder_bags.scanning import S_NS, BagScan, ClockSpan, SeenPicture, Track
from rn_recorder_bags.windows import Window, windows_of

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SampledEpisode:
    """Rows of one episode of a bag.

    Attributes:
        times_ns: int64 (n,), of the rows.
        state, action: float64 (n, k), in the order of the mapping.
        pictures: for each row, by camera.
    """

    instruction: str
    times_ns: I64
    state: F64
    action: F64
    pictures: Mapping[str, Sequence[SeenPicture]]

    @property
    def rows(self) -> int:
        """Their number."""
        return len(self.times_ns)


def sample(scan: BagScan, mapping: BagMapping) -> tuple[list[SampledEpisode], list[str]]:
    """The episodes of a bag, and a sentence for each gap in one."""
    episodes: list[SampledEpisode] = []
    told: list[str] = []
    windows = windows_of(scan, mapping)
    for span, found in zip(scan.spans, windows, strict=True):
        sampler = _SpanSampler(scan, span, mapping)
        for window in found:
            sampled, gaps = sampler.episodes(window)
            episodes += sampled
            told += gaps
    if not any(windows):
        told.append("nothing in it begins an episode")
    return episodes, told


@dataclass(frozen=True, slots=True)
class _Held:
    """A stream of samples: times int64 (n,) and values, and how long each may be held [ns]."""

    topic: str
    times_ns: I64
    samples: Sequence[Any]
    age_ns: int

    def places(self, at_ns: I64) -> I64:
        """Index of the sample that is held at each time, -1 for none."""
        if not len(self.times_ns):
            return np.full(len(at_ns), -1)
        found = np.searchsorted(self.times_ns, at_ns, side="right") - 1
        ages_ns = at_ns - self.times_ns[np.maximum(found, 0)]
        return np.where((found >= 0) & (ages_ns <= self.age_ns), found, -1)

    def values(self, at_ns: I64) -> list[Any]:
        """The sample that is held at each time; there is one."""
        return [self.samples[place] for place in self.places(at_ns)]


class _SpanSampler:
    """Samples one span of a bag."""

    def __init__(self, scan: BagScan, span: ClockSpan, mapping: BagMapping) -> None:
        self._span, self._mapping, self._begin_ns = span, mapping, scan.begin_ns
        cuts = mapping.episodes
        silence_s = (cuts.silence_s if cuts is not None else None) or 0.0
        self._state = self._numbers(mapping.state, span.state, 0.0)
        self._action = self._numbers(mapping.actions, span.action, silence_s)
        self._pictures = {
            camera: self._held(mapping.cameras[camera], span.pictures.get(camera, Track()), 0.0)
            for camera in scan.cameras
        }
        # a command belongs to the row before it; a state ends the row's step
        self._lead_ns = 0 if mapping.action == NEXT_STATE else 1

    def _numbers(
        self, sources: Sequence[NumberSource], tracks: Mapping[str, Track[float]], least_s: float
    ) -> list[_Held]:
        return [
            self._held(source, tracks.get(name, Track()), least_s)
            for source in sources
            for name in source.values.values()
        ]

    def _held(self, source: TopicSource, track: Track[Any], least_s: float) -> _Held:
        age_s = max(source.max_age_s or self._mapping.max_age_s, least_s)
        times_ns = np.array(track.times_ns, dtype=np.int64)
        return _Held(source.topic, times_ns, track.values, round(age_s * S_NS))

    def episodes(self, window: Window) -> tuple[list[SampledEpisode], list[str]]:
        """Uninterrupted rows of a window, and a sentence for each gap between them."""
        observed = [*self._state, *self._pictures.values()]
        begin_ns = window.begin_ns
        if not window.is_marked:
            firsts = [int(held.times_ns[0]) for held in observed if len(held.times_ns)]
            begin_ns = max([begin_ns, *firsts])
        grid = _Grid(begin_ns, self._mapping.fps)
        count = grid.steps_until(window.end_ns)
        if not count:
            return [], [f"an episode at {self._since_s(begin_ns):.2f} s is shorter than a row"]
        numbers = grid.near(observed[0], count)
        for held in observed:
            numbers = numbers[held.places(grid.at_ns(numbers)) >= 0]
        for held in self._action:
            numbers = numbers[held.places(self._then_ns(grid, numbers)) >= 0]
        runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
        episodes = [self._episode(window, grid, run) for run in runs if len(run)]
        edges = [(int(run[0]), int(run[-1]) + 1) for run in runs if len(run)]
        # what is before the first command of a bag is no gap
        first = 0 if window.is_marked or not edges else edges[0][0]
        places = [first, *chain.from_iterable(edges), count]
        gaps = zip(places[::2], places[1::2], strict=True)
        return episodes, [self._gap(grid, begin, end) for begin, end in gaps if begin < end]

    def _then_ns(self, grid: _Grid, numbers: I64) -> I64:
        """Times of the samples that are the actions of rows."""
        return grid.at_ns(numbers + 1) - self._lead_ns

    def _episode(self, window: Window, grid: _Grid, numbers: I64) -> SampledEpisode:
        now_ns, then_ns = grid.at_ns(numbers), self._then_ns(grid, numbers)
        return SampledEpisode(
            window.instruction,
            now_ns,
            np.array([held.values(now_ns) for held in self._state]).T,
            np.array([held.values(then_ns) for held in self._action]).T,
            {camera: held.values(now_ns) for camera, held in self._pictures.items()},
        )

    def _gap(self, grid: _Grid, first: int, end: int) -> str:
        """Why there are no rows from `first` to before `end`."""
        row = np.array([first])
        begin_ns, end_ns = grid.at_ns(np.array([first, end])).tolist()
        observed = [*self._state, *self._pictures.values()]
        silent = [held.topic for held in observed if held.places(grid.at_ns(row))[0] < 0]
        silent += [h.topic for h in self._action if h.places(self._then_ns(grid, row))[0] < 0]
        why = f"{', '.join(dict.fromkeys(silent))} is silent"
        leaps = [leap for leap in self._span.leaps if leap[0] < end_ns and leap[1] > begin_ns]
        if leaps:
            leap_ns = max(end - begin for begin, end in leaps)
            why = f"a clock jumps ahead by {leap_ns / S_NS:.3f} s"
        length_s = (end_ns - begin_ns) / S_NS
        return f"no rows for {length_s:.2f} s at {self._since_s(begin_ns):.2f} s: {why}"

    def _since_s(self, at_ns: int) -> float:
        return (at_ns - self._begin_ns) / S_NS


@dataclass(frozen=True, slots=True)
class _Grid:
    """Times of rows [ns]: row k is k periods after the first, rounded down."""

    begin_ns: int
    fps: int

    def at_ns(self, numbers: I64) -> I64:
        """Times of rows."""
        # in two steps, since clocks that jump by years would overflow
        seconds, rest = np.divmod(numbers, self.fps)
        times_ns: I64 = self.begin_ns + seconds * S_NS + rest * S_NS // self.fps
        return times_ns

    def steps_until(self, end_ns: int) -> int:
        """Number of rows whose step ends until then."""
        return max(0, (end_ns - self.begin_ns) * self.fps // S_NS)

    def near(self, held: _Held, count: int) -> I64:
        """Those of the first `count` rows at which a sample may be held, and few others."""
        pauses = np.flatnonzero(np.diff(held.times_ns) > held.age_ns)
        parts = np.split(held.times_ns, pauses + 1)
        spans = [(int(part[0]), int(part[-1]) + held.age_ns) for part in parts if len(part)]
        ranges = [
            np.arange(max(0, self.steps_until(begin)), min(count, self.steps_until(end) + 1))
            for begin, end in spans
        ]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *ranges]))
