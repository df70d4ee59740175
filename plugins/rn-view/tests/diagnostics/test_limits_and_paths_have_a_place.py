"""Which limit acts and where, and where the running chunk leads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rn_view.diagnostics.active_limits import SHOWN_S, ActiveLimits, limit_counts, limit_place
from rn_view.sources.source import PageState
from rn_view.visualization.predicted_path import PlannedChunk

REASONS = {
    "velocity": "j1 would move at 9 per second, allowed is 2.",
    "zone": "The TCP would enter 'table edge' on its way to (0.4, 0, 0) m.",
    "workspace": "The TCP would be 0.0200 m outside the workspace, at (1, 0, 0) m.",
    "speed": "The TCP would move at 0.9 m/s, allowed is 0.5 m/s.",
    "collision": "link7 and table edge would be 3.0 mm apart, at least 20 mm are allowed.",
}


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ("velocity", (("j1",), (), False, False)),
        ("zone", ((), ("table edge",), False, False)),
        ("workspace", ((), (), True, False)),
        ("speed", ((), (), False, True)),
        ("collision", ((), ("table edge",), False, False)),
    ],
)
def test_a_limit_is_placed_by_what_control_says(limit: str, expected: tuple[Any, ...]) -> None:
    place = limit_place((limit,), REASONS[limit], ("j1", "j10", "j"), ("table edge", "table"))
    assert (place.joints, place.zones, place.box, place.tcp) == expected


def test_no_limit_has_no_place() -> None:
    place = limit_place((), "j1 would move", (), ())
    assert (place.joints, place.zones, place.box, place.tcp) == ((), (), False, False)


def state(reason: str, **counts: int) -> PageState:
    return PageState(limit=reason, limit_counts=counts)


def test_a_limit_is_shown_while_it_acts_and_not_for_what_was_before() -> None:
    limits = ActiveLimits()
    first = limits.update(state("old", velocity=7), 10.0)
    assert (first.limits, first.limit) == ((), ""), "how long ago that was is not known"
    assert limits.update(state("new", velocity=8), 10.2).limits == ("velocity",)
    later = limits.update(state("new", velocity=8, zone=1), 10.4)
    assert (set(later.limits), later.limit) == ({"velocity", "zone"}, "new")
    assert limits.update(state("new", velocity=8, zone=1), 10.3 + SHOWN_S).limits == ("zone",)
    assert limits.update(state("new", velocity=8, zone=1), 12.0).limit == ""
    assert limits.update(state("new", velocity=1), 12.1).limits == (), "control began anew"
    assert limits.update(state("new", velocity=2), 12.2).limits == ("velocity",)
    assert limits.update(state("new", velocity=2), 3.0).limits == (), "a recording was rewound"


def test_counters_are_read_from_the_report_of_control() -> None:
    told = {"limited.velocity": "3", "limited.zone": "x", "limit": "a", "sent_share": "1"}
    assert limit_counts(told) == {"velocity": 3}


def prediction(space: str, rows: Any, **more: Any) -> str:
    told = {"rows": rows, "space": space, "step_s": 0.1, "ee_pose": {"position_m": [0.5, 0.0, 0.2]}}
    joints = {"names": ["a", "b"], "position": [1.0, 0.0]}
    return json.dumps({**told, "joints": joints, **more})


def forward(joints: Mapping[str, float]) -> dict[str, NDArray[np.float64]]:
    pose = np.eye(4)
    pose[:2, 3] = joints["a"], joints["b"]
    return {"": pose}


def path_of(text: str) -> list[list[float]]:
    chunk = PlannedChunk.parse(text, 5.0)
    assert chunk is not None
    return np.round(chunk.paths(forward)[""], 6).tolist()


def test_deltas_are_added_up_from_where_the_tcp_was_observed() -> None:
    rows = [[0.1, 0, 0, 0, 0, 0, 1], [0.1, 0, -0.05, 0, 0, 0, 1]]
    assert path_of(prediction("ee_delta_base", rows)) == [
        [0.5, 0.0, 0.2],
        [0.6, 0.0, 0.2],
        [0.7, 0.0, 0.15],
    ]


@pytest.mark.parametrize(
    ("space", "rows", "expected"),
    [
        ("ee_pose:x,y,z,qx,qy,qz,qw", [[1, 2, 3, 0, 0, 0, 1]], [[1, 2, 3]]),
        ("joint_position@10:a,b,gripper_open", [[2, 3, 1]], [[2, 3, 0]]),
        ("joint_delta:b,a", [[0.5, 1.0]], [[2, 0.5, 0]]),
        ("joint_velocity@10:a,b", [[1, 0], [1, 2]], [[1.1, 0, 0], [1.2, 0.2, 0]]),
    ],
)
def test_rows_of_every_space_lead_somewhere(space: str, rows: Any, expected: Any) -> None:
    assert path_of(prediction(space, rows)) == expected


def test_of_two_arms_each_has_a_path() -> None:
    keys = ",".join(f"{arm}/{axis}" for arm in ("left", "right") for axis in "xyz")
    chunk = PlannedChunk.parse(prediction(f"ee_pose:{keys}", [[1, 2, 3, 4, 5, 6]]), 0.0)
    assert chunk is not None
    found = {arm: points.tolist() for arm, points in chunk.paths(None).items()}
    assert found == {"left": [[1, 2, 3]], "right": [[4, 5, 6]]}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        json.dumps({"error": "late", "instruction": "x"}),
        prediction("ee_delta_base", [[1, 2]]),
        prediction("ee_delta_base", [[float("nan")] * 7]),
        prediction("ee_delta_base", [1, 2]),
        prediction("ee_pose:x", [["?"]]),
        prediction("ee_pose:x", [[1]], arms=[1]),
    ],
)
def test_what_is_no_chunk_leads_nowhere(text: str) -> None:
    assert PlannedChunk.parse(text, 0.0) is None


def test_a_chunk_ends_a_while_after_its_last_row() -> None:
    chunk = PlannedChunk.parse(prediction("ee_pose:x,y,z", [[0, 0, 0]] * 10), 5.0)
    assert chunk is not None
    assert not chunk.is_over(6.9)
    assert chunk.is_over(7.1)
    assert chunk.is_over(4.0), "a recording was rewound"
