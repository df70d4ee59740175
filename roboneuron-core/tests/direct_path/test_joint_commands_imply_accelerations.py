"""Positions at times imply accelerations: what no joint can follow within its limit is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboneuron.contract import JointSample
from roboneuron.errors import RefusedError
from roboneuron.gate.motion.acceleration import Speeds, shortest_s

A, FAST = 10.0, 100.0


def trajectory(*points: tuple[float, float]) -> dict[str, Any]:
    return {
        "joint_names": ["j1"],
        "points": [{"positions": [q], "time_from_start": t} for t, q in points],
    }


def moving(velocity: float) -> JointSample:
    return JointSample(
        names=("j1", "j2", "finger"), position=np.zeros(3), velocity=np.array([velocity, 0.0, 0.0])
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (trajectory((0.26, 0.5)), r"j1 cannot go 0.5 in that time: its acceleration is at most 10"),
        (
            trajectory((0.35, 0.5)),
            r"j1 cannot go 0.5 in that time and rest there.*at most 10.*it needs 0.45 s",
        ),
        (trajectory((0.1, 0.1)), "j1 cannot go 0.1 in that time"),
        (trajectory((0.5, 0.5), (1.0, -0.4)), r"points\[1\]: j1 cannot go"),
        (trajectory((1.0, 0.0), (1.15, 0.25)), r"points\[1\]: j1 cannot go 0.25"),
    ],
)
def test_a_move_that_needs_more_acceleration_than_there_is_is_refused(
    make_gate, ask, endpoints, value, text
) -> None:
    with pytest.raises(RefusedError, match=text):
        make_gate().check(ask(endpoints["trajectory"], value))


@pytest.mark.parametrize(
    "value", [trajectory((0.46, 0.5)), trajectory((0.7, 0.5), (1.6, -0.4), (2.1, -0.4))]
)
def test_what_the_joints_can_follow_passes(make_gate, ask, endpoints, value) -> None:
    assert make_gate().check(ask(endpoints["trajectory"], value)).may_send


def test_the_first_segment_begins_with_the_measured_velocity(make_gate, ask, endpoints) -> None:
    value = trajectory((0.46, 0.5))
    with pytest.raises(RefusedError, match="cannot go"):
        make_gate().check(ask(endpoints["trajectory"], value, joints=moving(-1.5)))
    assert (
        make_gate()
        .check(ask(endpoints["trajectory"], trajectory((0.6, 0.5)), joints=moving(1.0)))
        .may_send
    )


def test_joint_states_are_judged_by_how_long_they_last(make_gate, ask, endpoints) -> None:
    gate, joints = make_gate(), endpoints["joints"]
    step = ask(joints, {"name": ["j1"], "position": [0.5]}, durations_s=(0.35,))
    with pytest.raises(RefusedError, match="rest there"):
        gate.check(step)
    assert gate.check(replace(step, durations_s=(0.46,))).may_send
    spin = ask(joints, {"name": ["j1"], "velocity": [1.5]}, durations_s=(0.1,))
    with pytest.raises(RefusedError, match="cannot go"):
        gate.check(spin)
    assert gate.check(replace(spin, durations_s=(0.2,))).may_send
    with pytest.raises(RefusedError, match="duration of the velocities is not known"):
        gate.check(replace(spin, durations_s=()))


def test_steps_follow_each_other_without_resting_but_rest_in_a_pause(
    make_gate, ask, endpoints
) -> None:
    there, on = (
        ask(endpoints["trajectory"], trajectory((0.35, q))).messages[0] for q in (0.4, 0.9)
    )
    request = replace(ask(endpoints["trajectory"], trajectory((0.35, 0.4))), messages=(there, on))
    assert make_gate().check(replace(request, durations_s=(0.35, 0.35))).may_send
    with pytest.raises(
        RefusedError, match=r"steps\[0\]: j1 cannot go 0.4 in that time and rest there"
    ):
        make_gate().check(replace(request, durations_s=(1.0, 0.35)))


def test_a_finger_has_no_acceleration_limit(make_gate, ask, endpoints) -> None:
    value = {"joint_names": ["finger"], "points": [{"positions": [0.04], "time_from_start": 0.01}]}
    assert make_gate().check(ask(endpoints["trajectory"], value)).may_send


@settings(max_examples=300, deadline=None)
@given(
    st.floats(-2.0, 2.0), st.lists(st.floats(-A, A), min_size=1, max_size=6), st.floats(0.01, 0.5)
)
def test_every_motion_within_the_acceleration_is_allowed(
    start: float, pieces: list[float], piece_s: float
) -> None:
    velocity, distance = start, 0.0
    for a in pieces:
        distance += velocity * piece_s + a * piece_s**2 / 2
        velocity += a * piece_s
    after = Speeds(start, start).after(distance, piece_s * len(pieces), A, FAST)
    assert after is not None
    # a hundred times the slack of the limit, in time 0.5 s
    assert after.at(velocity, 1e-4) is not None


@settings(max_examples=300, deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(0.05, 2.0), st.floats(0.0, 1.0), st.booleans())
def test_the_ends_of_the_interval_are_bang_bang_motions(
    start: float, time_s: float, share: float, up: bool
) -> None:
    first = A if up else -A
    t1, t2 = share * time_s, (1.0 - share) * time_s
    middle = start + first * t1
    distance = start * t1 + first * t1**2 / 2 + middle * t2 - first * t2**2 / 2
    end = middle - first * t2
    after = Speeds(start, start).after(distance, time_s, A, FAST)
    assert after is not None
    assert (after.low if up else after.high) == pytest.approx(
        end, abs=0.05
    )  # the slack's square root, at share 0 and 1


def test_shortest_time_is_where_the_interval_begins_to_hold_rest() -> None:
    rest = Speeds(0.0, 0.0)
    needed = shortest_s(0.5, A)
    for time_s, possible in ((needed * 1.001, True), (needed * 0.999, False)):
        after = rest.after(0.5, time_s, A, FAST)
        assert (after is not None and after.at(0.0, 1e-6) is not None) is possible
