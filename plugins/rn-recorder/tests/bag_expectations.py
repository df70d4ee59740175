"""What an import of `lab_bags` must give, from the rules of the documentation, by plain loops."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from lab_bags import (
    CAMERA_MS,
    COMMANDS_MS,
    GAP_MS,
    JOINTS_MS,
    JUMP_AT_MS,
    JUMP_MS,
    LENGTH_MS,
    MARKS_MS,
    MS_NS,
    SILENCE_MS,
    START_NS,
    CommandKind,
    CutKind,
    command,
    joints,
)

from rn_recorder_bags.mapping import BagMapping, read_mapping

PERIOD_MS, AGE_MS, PAUSE_MS = 50, 200, 400
Stream = list[tuple[int, int]]


@dataclass
class Expected:
    """One episode: for each row its time [ns], state, action and picture."""

    instruction: str
    rows: list[tuple[int, list[float], list[float], int]] = field(default_factory=list)


@dataclass(frozen=True)
class Window:
    """Time of an episode [ns]."""

    begin_ns: int
    end_ns: int
    instruction: str
    is_marked: bool


def mapping_of(folder: Path, text: str) -> BagMapping:
    """The mapping in a file with that text."""
    path = folder / "map.toml"
    path.write_text(text)
    return read_mapping(path)


def expected(commands: CommandKind, cut: CutKind) -> list[Expected]:
    """The episodes of `lab_events`."""
    found: list[Expected] = []
    for is_late in (False, True):
        states = stream(range(0, LENGTH_MS, JOINTS_MS), is_late)
        shown = [ms for ms in range(7, LENGTH_MS, CAMERA_MS) if not GAP_MS[0] <= ms < GAP_MS[1]]
        pictures = stream(shown, is_late)
        acts = stream(range(3, LENGTH_MS, COMMANDS_MS), is_late)
        if not is_late:
            silent = [START_NS + ms * MS_NS for ms in SILENCE_MS]
            acts = [one for one in acts if not silent[0] <= one[0] < silent[1]]
        if commands == "next_state":
            acts = states
        for window in windows(cut, states, acts, pictures, is_late):
            found += episodes(window, commands, cut, states, acts, pictures)
    return found


def stream(times_ms: Iterable[int], is_late: bool) -> Stream:
    """Times [ns] and numbers of what was sent before the clock jumped, or since."""
    return [
        (START_NS + (ms - JUMP_MS * is_late) * MS_NS, number)
        for number, ms in enumerate(times_ms)
        if (ms >= JUMP_AT_MS) == is_late
    ]


def windows(
    cut: CutKind, states: Stream, acts: Stream, pictures: Stream, is_late: bool
) -> Iterator[Window]:
    """The episodes before the clock jumped, or since."""
    streams = (states, acts, pictures)
    begin_ns = min(one[0][0] for one in streams)
    end_ns = max(one[-1][0] for one in streams)
    if cut == "bag":
        yield Window(begin_ns, end_ns, "wave", False)
    elif cut == "silence":
        burst = [acts[0][0]]
        for at_ns, _ in acts[1:]:
            if at_ns - burst[-1] > PAUSE_MS * MS_NS:
                yield Window(burst[0], burst[-1], "wave", False)
                burst = []
            burst.append(at_ns)
        yield Window(burst[0], burst[-1], "wave", False)
    elif is_late:
        yield Window(begin_ns, end_ns, MARKS_MS[-1][1] if cut == "text" else "wave", False)
    else:
        marks = [(START_NS + ms * MS_NS, text) for ms, text in MARKS_MS] + [(end_ns, "")]
        for (at_ns, text), (until_ns, _) in pairwise(marks):
            if text or cut == "empty":
                yield Window(at_ns, until_ns, text if cut == "text" else "wave", True)


def episodes(
    window: Window,
    commands: CommandKind,
    cut: CutKind,
    states: Stream,
    acts: Stream,
    pictures: Stream,
) -> list[Expected]:
    """The uninterrupted rows of a window."""
    found: list[Expected] = []
    at_ns = window.begin_ns
    if not window.is_marked:
        at_ns = max(at_ns, states[0][0], pictures[0][0])
    act_age_ms = PAUSE_MS if cut == "silence" else AGE_MS
    is_open = False
    while at_ns + PERIOD_MS * MS_NS <= window.end_ns:
        next_ns = at_ns + PERIOD_MS * MS_NS
        state = newest(states, at_ns, AGE_MS)
        shown = newest(pictures, at_ns, AGE_MS)
        is_next = commands == "next_state"
        act = newest(acts, next_ns if is_next else next_ns - 1, act_age_ms)
        if state is None or shown is None or act is None:
            is_open = False
        else:
            if not is_open:
                found.append(Expected(window.instruction))
            is_open = True
            asked = joints(act) if is_next else command(act)
            ours = [asked[1], asked[0], asked[2]][: 2 if commands == "own type" else 3]
            measured = joints(state)
            row = (at_ns, [measured[1], measured[0], measured[2]], ours, shown)
            found[-1].rows.append(row)
        at_ns = next_ns
    return found


def newest(stream: Stream, at_ns: int, age_ms: int) -> int | None:
    """Number of the newest sample that is not younger and not too old."""
    best = None
    for time_ns, number in stream:
        if time_ns <= at_ns and at_ns - time_ns <= age_ms * MS_NS:
            best = number
    return best
