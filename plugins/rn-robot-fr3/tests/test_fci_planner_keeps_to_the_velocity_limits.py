"""A plan, executed by a braking joint in virtual time, never exceeds the position-dependent
envelope.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rn_robot_fr3.fci.planner import (
    ACCELERATION_LIMIT_RAD_S2,
    MARGIN_RAD,
    VELOCITY_LIMIT_RAD_S,
    plan,
)
from rn_robot_fr3.limits import LOWER_RAD, UPPER_RAD, velocity_bounds
from rn_robot_fr3.profile import HOME_RAD

F64 = NDArray[np.float64]
LOWER, UPPER = np.array(LOWER_RAD), np.array(UPPER_RAD)
STEP_S = 0.001


def positions() -> st.SearchStrategy[F64]:
    share = st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7)
    return share.map(lambda s: LOWER + MARGIN_RAD + np.array(s) * (UPPER - LOWER - 2 * MARGIN_RAD))


@given(start=positions(), target=positions(), factor=st.sampled_from([0.1, 0.3, 1.0]))
def test_the_fastest_motion_that_the_plan_allows_stays_inside_the_envelope(
    start: F64, target: F64, factor: float
) -> None:
    course = plan(start, target, 0.1, factor)
    speed = course.velocity_factor * VELOCITY_LIMIT_RAD_S
    acceleration = factor * ACCELERATION_LIMIT_RAD_S2
    direction = np.sign(course.target - start)
    length = np.abs(course.target - start)
    for share in np.linspace(0.0, 1.0, 101):
        gone = share * length
        # without a jerk limit, so nowhere slower than ruckig: accelerate, cruise, brake
        fastest = np.minimum(
            np.sqrt(2 * acceleration * gone), np.sqrt(2 * acceleration * (length - gone))
        )
        velocity = direction * np.minimum(speed, fastest)
        lowest, highest = velocity_bounds(start + direction * gone)
        # the lowest speed of the plan; below, the joint creeps
        moving = np.abs(velocity) > 0.11
        towards = np.where(velocity > 0, highest - velocity, velocity - lowest)
        assert (towards[moving & (gone > 0.5 * length)] >= -1e-6).all()


def test_a_target_beyond_the_limits_is_moved_inside_them() -> None:
    course = plan(np.array(HOME_RAD), UPPER + 1.0, 1.0, 0.3)
    assert (course.target <= UPPER - MARGIN_RAD + 1e-12).all()
    assert (MARGIN_RAD < 0.03).all()


def test_a_long_duration_makes_the_motion_slow() -> None:
    home = np.array(HOME_RAD)
    course = plan(home, home + 0.2, 4.0, 0.5)
    slowest = course.velocity_factor * VELOCITY_LIMIT_RAD_S.min()
    assert 0.2 / 4.0 <= slowest <= 0.2 / 3.0
    assert course.duration_s == pytest.approx(4.0, rel=0.05)


def test_far_from_the_limits_the_whole_share_is_used_and_the_estimate_grows_with_the_way() -> None:
    home = np.array(HOME_RAD)
    near, far = (plan(home, home + step, 0.01, 0.5) for step in (0.1, 0.4))
    assert near.velocity_factor == pytest.approx(0.5)
    assert far.duration_s > near.duration_s
    assert plan(home, home, 2.0, 0.5).duration_s == 2.0
