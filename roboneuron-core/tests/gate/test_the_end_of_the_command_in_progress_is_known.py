"""Position and time of the end of the command in progress, for rows that add to it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from gantry import ARM, at, limiter, profile, to

from roboneuron.contract import JointSample


def test_joints_at_its_end_are_told_by_name_and_others_as_measured() -> None:
    judge = limiter()
    judge.limit(to(0.05, 0.02), at(), 10.0)
    measured = JointSample(
        names=("finger", *reversed(ARM)), position=np.array([0.03, 0.0, 0.01, 0.02]), stamp_ns=7
    )
    end = judge.reference(measured, 10.05)
    assert end.names == measured.names
    assert end.position.tolist() == pytest.approx([0.03, 0.0, 0.02, 0.05])
    assert end.stamp_ns == 7
    assert measured.position.tolist() == [0.03, 0.0, 0.01, 0.02], "nobody writes into it"


def test_a_command_that_was_cut_off_ends_where_it_was_cut_off() -> None:
    judge = limiter(robot=profile(velocity=0.2))
    judge.limit(to(0.05), at(), 10.0)
    assert judge.reference(at(0.01), 10.05).position[0] == pytest.approx(0.02)


@pytest.mark.parametrize(("now_s", "end"), [(10.1, 0.05), (10.999, 0.05), (11.0, 0.04)])
def test_it_is_remembered_for_a_second(now_s: float, end: float) -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    assert judge.reference(at(0.04), now_s).position[0] == end


@pytest.mark.parametrize(("place", "end"), [(0.12, 0.05), (0.126, 0.126), (-0.08, -0.08)])
def test_an_arm_that_does_not_follow_is_where_it_is_measured(place: float, end: float) -> None:
    """More than 0.1 away from 0.025, where the command is after half of its time."""
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    assert judge.reference(at(place), 10.05).position[0] == end


@pytest.mark.parametrize(
    "measured", [at(math.nan), JointSample(names=("x",), position=np.array([0.01]))]
)
def test_joints_that_cannot_be_read_come_back(measured: JointSample) -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    assert judge.reference(measured, 10.05) is measured


def test_without_a_command_the_arm_is_where_it_is_measured() -> None:
    measured = at(0.3)
    judge = limiter()
    assert judge.reference(measured, 10.0) is measured
    assert judge.remaining_s(10.0) == 0.0
    judge.limit(to(0.05), at(), 10.0)
    judge.rest(None, 10.05)
    assert judge.reference(measured, 10.06) is measured
    assert judge.remaining_s(10.06) == 0.0


def test_an_arm_at_rest_has_no_time_left() -> None:
    judge = limiter()
    judge.rest(at(0.3), 10.0)
    assert judge.remaining_s(10.0) == 0.0
    assert judge.reference(at(0.31), 10.1).position[0] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("now_s", "left_s"), [(10.0, 0.1), (10.04, 0.06), (10.1, 0.0), (10.2, 0.0), (99.0, 0.0)]
)
def test_the_time_that_is_left_is_told(now_s: float, left_s: float) -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    assert judge.remaining_s(now_s) == pytest.approx(left_s, abs=1e-12)


def test_a_command_that_carries_no_time_has_none_left() -> None:
    judge = limiter(immediate=True)
    judge.limit(to(0.05), at(), 10.0)
    assert judge.remaining_s(10.01) == 0.0
