"""Times of messages, clocks that jump, trajectories, marks of episodes, and the mapping file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_expectations import mapping_of
from lab_bags import Event, joint_state, make, trajectory, write_bag

from rn_recorder_bags.bag_files import find_bag
from rn_recorder_bags.sampling import SampledEpisode, sample
from rn_recorder_bags.scanning import scan
from roboneuron import ConfigurationError

START_NS, MS = 10**18, 10**6
STATE = "[[state]]\ntopic = '/q'\nvalues = { a = 'joint' }\n"
TEN_HZ = f"fps = 10\naction = 'next_state'\n{STATE}"
Times = Sequence[tuple[int, int]]
"""For each joint state when it was recorded and its stamp, both after the start [ms]."""


def states(times_ms: Times) -> list[Event]:
    """Joint states 0, 1, ..."""
    return [
        Event(START_NS + log_ms * MS, "/q", joint_state("a", [n], START_NS + stamp_ms * MS))
        for n, (log_ms, stamp_ms) in enumerate(times_ms)
    ]


def regular(count: int, begin_ms: int = 0) -> Times:
    """One each 100 ms."""
    return [(begin_ms + 100 * n, begin_ms + 100 * n) for n in range(count)]


def sampled(
    tmp_path: Path, text: str, events: Sequence[Event]
) -> tuple[list[SampledEpisode], list[str]]:
    """Episodes of a bag of these messages, and all that is told."""
    bag = find_bag(write_bag(tmp_path / "bag", "mcap", events))
    found = scan(bag, mapping_of(tmp_path, text))
    episodes, gaps = sample(found, mapping_of(tmp_path, text))
    return episodes, [*found.left_out, *gaps]


def rows_of(episodes: Sequence[SampledEpisode]) -> list[tuple[str, list[int]]]:
    """Instruction and states of each episode."""
    return [(one.instruction, one.state[:, 0].astype(int).tolist()) for one in episodes]


YEARS_MS = 30 * 365 * 86_400_000
CLOCKS: dict[str, tuple[str, Times, list[list[int]], str]] = {
    "steady": ("log", regular(6), [[0, 1, 2, 3, 4]], ""),
    "recorded late": ("log", [(130 + 100 * n, 100 * n) for n in range(6)], [[0, 1, 2, 3, 4]], ""),
    "stamps": ("header", [(7 * n * n, 100 * n) for n in range(6)], [[0, 1, 2, 3, 4]], ""),
    "a little back": ("log", [(0, 0), (100, 0), (250, 0), (200, 0), (300, 0)], [[0, 1, 3]], ""),
    "back": (
        "log",
        [*regular(5), *[(ms - 3000, ms) for ms, _ in regular(5, 500)]],
        [[0, 1, 2, 3], [5, 6, 7, 8]],
        "a clock jumps back by 2.900 s at 0.40 s",
    ),
    "stamps back": (
        "header",
        [*regular(5), *[(ms, ms - 3000) for ms, _ in regular(5, 500)]],
        [[0, 1, 2, 3], [5, 6, 7, 8]],
        "a clock jumps back by 2.900 s at 0.40 s",
    ),
    "ahead": (
        "log",
        [*regular(5), *[(ms + 3_600_000, ms) for ms, _ in regular(5, 500)]],
        [[0, 1, 2, 3, 4, 4], [5, 6, 7, 8]],
        "a clock jumps ahead by 3600.100 s",
    ),
    "ahead by years": (
        "header",
        [*regular(5), *[(ms, ms + YEARS_MS) for ms, _ in regular(5, 500)]],
        [[0, 1, 2, 3, 4, 4], [5, 6, 7, 8]],
        "a clock jumps ahead by 946080000.100 s",
    ),
    "silence": (
        "log",
        [*regular(5), *regular(5, 1500)],
        [[0, 1, 2, 3, 4, 4], [5, 6, 7, 8]],
        "no rows for 0.90 s at 0.60 s: /q is silent",
    ),
    "a stamp of 0": (
        "header",
        [(0, -START_NS // MS), *regular(3, 100)],
        [[1, 2]],
        "its stamp is 0",
    ),
}


@pytest.mark.parametrize("case", CLOCKS)
def test_clocks_that_jump_are_told_and_end_episodes(tmp_path: Path, case: str) -> None:
    clock, times_ms, wanted, word = CLOCKS[case]
    episodes, told = sampled(tmp_path, f"time = '{clock}'\n{TEN_HZ}", states(times_ms))
    assert [rows for _, rows in rows_of(episodes)] == wanted
    assert [word in one for one in told] == ([True] if word else [])
    steps = np.concatenate([np.diff(one.times_ns) for one in episodes])
    assert set(steps.tolist()) == {100 * MS}


def test_points_of_a_trajectory_hold_until_they_are_reached(tmp_path: Path) -> None:
    """A row's action is the point that the arm goes to; a new trajectory ends the one before."""
    text = (
        f"fps = 10\nmax_age_s = 2.0\n{STATE}[[action]]\ntopic = '/go'\nvalues = {{ a = 'joint' }}\n"
    )
    plans = [(0, [(250, 1.0), (500, 2.0), (900, 3.0)]), (600, [(100, 7.0), (300, 8.0)])]
    events = states(regular(11))
    for at_ms, points in plans:
        message = trajectory("a", [(after_ms * MS, [value]) for after_ms, value in points])
        events.append(Event(START_NS + at_ms * MS, "/go", message))
    events.sort(key=lambda event: event.at_ns)
    (episode,), told = sampled(tmp_path, text, events)
    assert told == []
    assert episode.action[:, 0].tolist() == [1, 1, 2, 2, 2, 3, 7, 8, 8, 8]


def string(text: str) -> Any:
    return make("std_msgs/String", data=text)


def truth(value: bool) -> Any:
    return make("std_msgs/Bool", data=value)


def number(value: int) -> Any:
    return make("std_msgs/Int32", data=value)


EMPTY = make("std_msgs/Empty", structure_needs_at_least_one_member=0)
REPEATED = [(ms, truth(200 <= ms < 600)) for ms in range(0, 1000, 50)]
ONE, TWO = ("wave", [1, 2, 3]), ("wave", [5, 6, 7, 8])
CUTS: dict[str, tuple[str, list[tuple[int, Any]], list[tuple[str, list[int]]]]] = {
    "texts": (
        "",
        [(0, string("up")), (400, string("down"))],
        [("up", [0, 1, 2, 3]), ("down", [4, 5, 6, 7, 8])],
    ),
    "texts and an end": ("", [(200, string("up")), (500, string(""))], [("up", [2, 3, 4])]),
    "a text that is repeated": (
        "",
        [(0, string("up")), (100, string("up")), (300, string(""))],
        [("up", [0, 1, 2])],
    ),
    "words": (
        "begin = 'go'\nend = 'stop'",
        [(100, string("go")), (200, string("ready")), (400, string("stop")), (500, string("go"))],
        [ONE, TWO],
    ),
    "a state": ("", REPEATED, [("wave", [2, 3, 4, 5])]),
    "turned": ("begin = false\nend = true", [(100, truth(False)), (400, truth(True))], [ONE]),
    "numbers": (
        "",
        [(100, number(1)), (400, number(0)), (500, number(2))],
        [ONE, TWO],
    ),
    "a button": ("", [(100, EMPTY), (500, EMPTY)], [("wave", [1, 2, 3, 4]), TWO]),
    "none": ("begin = 'start'", [(0, string("stop"))], []),
}


@pytest.mark.parametrize("case", CUTS)
def test_marks_cut_episodes(tmp_path: Path, case: str) -> None:
    keys, marks, wanted = CUTS[case]
    events = states(regular(10))
    events += [Event(START_NS + ms * MS, "/mark", message) for ms, message in marks]
    events.sort(key=lambda event: event.at_ns)
    text = f"instruction = 'wave'\n{TEN_HZ}[episodes]\ntopic = '/mark'\n{keys}\n"
    episodes, told = sampled(tmp_path, text, events)
    assert rows_of(episodes) == wanted
    assert told == ([] if wanted else ["nothing in it begins an episode"])


def test_what_a_marked_episode_lacks_is_told(tmp_path: Path) -> None:
    events = [Event(START_NS, "/mark", string("up")), *states(regular(10, 300))]
    text = f"{TEN_HZ}[episodes]\ntopic = '/mark'\n"
    episodes, told = sampled(tmp_path, text, events)
    assert rows_of(episodes) == [("up", [0, 1, 2, 3, 4, 5, 6, 7, 8])]
    assert told == ["no rows for 0.30 s at 0.00 s: /q is silent"]


def test_an_episode_without_a_row_is_told(tmp_path: Path) -> None:
    marks = [(100, string("up")), (150, string("")), (400, string("down"))]
    events = states(regular(10))
    events += [Event(START_NS + ms * MS, "/mark", message) for ms, message in marks]
    events.sort(key=lambda event: event.at_ns)
    episodes, told = sampled(tmp_path, f"{TEN_HZ}[episodes]\ntopic = '/mark'\n", events)
    assert rows_of(episodes) == [("down", [4, 5, 6, 7, 8])]
    assert told == ["an episode at 0.10 s is shorter than a row"]


MAPPINGS = {
    "": "fps",
    "fps = [": "not valid TOML",
    f"{TEN_HZ}[cams]\n": "cams",
    "fps = 10\naction = 'later'\n" + STATE: "action",
    "fps = 10\naction = []\n" + STATE: "action",
    "fps = 10\n" + STATE: "action",
    "fps = 0\naction = 'next_state'\n" + STATE: "fps",
    "fps = 10.5\naction = 'next_state'\n" + STATE: "fps",
    "fps = 10\naction = 'next_state'\nstate = []\n": "state",
    TEN_HZ + STATE: "joint of the data set is named twice",
    f"{TEN_HZ}[episodes]\n": "either topic or silence_s",
    f"{TEN_HZ}[episodes]\ntopic = '/a'\nsilence_s = 1.0\n": "either topic or silence_s",
    f"{TEN_HZ}[cameras.front]\ntopic = '/a'\n[cameras.hand]\ntopic = '/a'\n": "the same topic",
    f"{TEN_HZ}[cameras.'../front']\ntopic = '/a'\n": "../front",
}


@pytest.mark.parametrize("text", MAPPINGS)
def test_a_mapping_that_does_not_fit_names_the_key(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigurationError) as refusal:
        mapping_of(tmp_path, text)
    assert MAPPINGS[text] in refusal.value.message
    assert "map.toml" in refusal.value.message
