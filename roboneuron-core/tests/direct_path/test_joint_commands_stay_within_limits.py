"""Names, positions, velocities and times of joint commands, and the first step from where the
joints are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from roboneuron.contract import JointSample
from roboneuron.errors import RefusedError
from roboneuron.feature import MotionRules


def trajectory(
    *points: tuple[float, list[float]], names: tuple[str, ...] = ("j1", "j2")
) -> dict[str, Any]:
    return {
        "joint_names": list(names),
        "points": [{"positions": q, "time_from_start": t} for t, q in points],
    }


def with_rates(**rates: list[float]) -> dict[str, Any]:
    return {"joint_names": ["j1"], "points": [{"positions": [0], "time_from_start": 1, **rates}]}


def test_a_trajectory_within_all_limits_passes(make_gate, ask, endpoints) -> None:
    value = trajectory((0.8, [1.0, 0.5]), (2.3, [-1.0, 0.5]))
    assert make_gate().check(ask(endpoints["trajectory"], value)).may_send


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (trajectory((1.0, [1.1, 0.0])), "position of j1 is 1.1, allowed is -1 .. 1"),
        (trajectory((0.4, [1.0, 0.0])), "j1 would move at 2.5 per second, allowed is 2"),
        (trajectory((1.0, [0, 0]), (1.2, [0, 0.5])), r"points\[1\]: j2 would move"),
        (trajectory((1.0, [0, 0]), (1.0, [0, 0])), "time_from_start is 1 s, expected more than 1"),
        (trajectory((-1.0, [0, 0])), "time_from_start"),
        (trajectory((0.0, [0.5, 0])), "time_from_start is 0"),
        (trajectory((1.0, [0.0])), "1 positions for 2 joints"),
        (trajectory((1.0, [])), "0 positions for 2 joints"),
        (trajectory(), "0 points"),
        (trajectory((1.0, []), names=()), "names no joints"),
        (trajectory((1.0, [0, 0]), names=("j1", "j1")), "twice"),
        (trajectory((1.0, [0, 0]), names=("j1", "elbow")), "'elbow' is unknown"),
        (trajectory((1.0, [0.05]), names=("finger",)), "position of finger"),
        (with_rates(velocities=[3.0]), "velocity of j1"),
        (with_rates(velocities=[0, 0]), "2 values for 1"),
        (with_rates(accelerations=[-11]), "acceleration of j1"),
    ],
)
def test_what_the_arm_cannot_do_is_refused(make_gate, ask, endpoints, value, text) -> None:
    with pytest.raises(RefusedError, match=text):
        make_gate().check(ask(endpoints["trajectory"], value))


def test_a_joint_is_held_to_the_shares_of_its_limits_that_the_rules_allow(
    make_gate, ask, endpoints
) -> None:
    rules = MotionRules(reactions={}, velocity_fraction=0.5, acceleration_fraction=0.2)
    gate = make_gate(rules=rules)
    with pytest.raises(RefusedError, match="allowed is 1"):
        gate.check(ask(endpoints["trajectory"], trajectory((0.9, [1.0, 0.0]))))
    with pytest.raises(RefusedError, match="acceleration is at most 2 per"):
        gate.check(ask(endpoints["trajectory"], trajectory((1.2, [1.0, 0.0]))))
    assert gate.check(ask(endpoints["trajectory"], trajectory((1.5, [1.0, 0.0])))).may_send


def test_a_first_point_at_time_zero_may_repeat_where_the_joints_are(
    make_gate, ask, endpoints
) -> None:
    value = trajectory((0.0, [0.0005, 0.0]), (1.0, [0.5, 0.0]))
    assert make_gate().check(ask(endpoints["trajectory"], value)).may_send


def test_the_first_step_starts_where_the_joints_are(make_gate, ask, endpoints) -> None:
    value = trajectory((0.3, [0.9, 0.0]))
    there = JointSample(names=("j2", "j1"), position=np.array([0.0, 0.8]))
    assert make_gate().check(ask(endpoints["trajectory"], value, joints=there)).may_send
    for unknown in (None, JointSample(names=("j1",), position=np.zeros(1))):
        with pytest.raises(RefusedError, match="cannot be checked"):
            make_gate().check(ask(endpoints["trajectory"], value, joints=unknown))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"name": ["j1"], "position": [1.5]}, "position of j1"),
        ({"name": ["j1"], "velocity": [-2.5]}, "velocity of j1"),
        ({"name": ["j1"], "position": [0.0], "effort": [51.0]}, "effort of j1"),
        ({"name": ["j1"]}, "neither positions nor velocities"),
        ({"position": [0.0]}, "names no joints"),
        ({"name": ["j1", "j2"], "position": [0.0]}, "1 values for 2 joints"),
    ],
)
def test_joint_states_are_held_to_the_limits(make_gate, ask, endpoints, value, text) -> None:
    with pytest.raises(RefusedError, match=text):
        make_gate().check(ask(endpoints["joints"], value))
    assert make_gate().check(ask(endpoints["joints"], {"name": ["j2"], "position": [0.5]})).may_send


def test_joint_limits_that_cannot_be_checked_refuse(make_gate, ask, endpoints) -> None:
    other = replace(endpoints["velocity"], joint_limited=True)
    with pytest.raises(RefusedError, match="cannot be checked for geometry_msgs/msg/Twist"):
        make_gate(other).check(ask(other, {}))


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    steps=st.lists(
        st.tuples(st.floats(0.01, 1.0), st.lists(st.floats(-1.3, 1.3), min_size=2, max_size=2)),
        min_size=1,
        max_size=5,
    )
)
def test_what_passes_never_exceeds_a_limit(make_gate, ask, endpoints, steps) -> None:
    times = np.cumsum([dt for dt, _ in steps])
    points = [(float(t), q) for t, (_, q) in zip(times, steps, strict=True)]
    path = np.array([[0.0, 0.0], *(q for _, q in points)])
    speeds = np.abs(np.diff(path, axis=0)) / np.array([dt for dt, _ in steps])[:, None]
    possible = bool((np.abs(path) <= 1.0).all() and (speeds <= 2.0).all())
    close = bool((np.abs(np.abs(path) - 1.0) < 1e-5).any() or (np.abs(speeds - 2.0) < 1e-4).any())
    try:
        passed = make_gate().check(ask(endpoints["trajectory"], trajectory(*points))).may_send
    except RefusedError:
        passed = False
    needed = 4.0 * np.abs(np.diff(path, axis=0)) / np.array([dt for dt, _ in steps])[:, None] ** 2
    assert possible or close or not passed
    # from rest to rest, so that no acceleration is too high
    if possible and not close and (needed < 9.99).all():
        assert passed
