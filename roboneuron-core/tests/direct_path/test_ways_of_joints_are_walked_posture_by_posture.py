"""At which postures an arm that slides is judged on its way, and what is said of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    CollisionProfile,
    JointLimits,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
)
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion import path_limits
from roboneuron.gate.motion.path import Reach
from roboneuron.gate.motion.path_limits import Leg, LimitError, PathLimiter
from roboneuron.gate.motion.rules import motion_rules

PROFILE = RobotProfile(
    name="arm",
    arm_joints=("x", "y"),
    tcp_link="tcp",
    limits=JointLimits(
        lower=np.full(2, -9.0),
        upper=np.full(2, 9.0),
        velocity=np.full(2, 9.0),
        acceleration=np.full(2, 9.0),
        effort=np.ones(2),
    ),
)
"""Slides along x and y, 0.4 m above the floor."""
START = JointSample(names=("x", "y"), position=np.array([1.0, 2.0]))
SLOW = {"max_speed_m_s": 0.5, "max_turn_rad_s": 1.0}


class Slide:
    """Answers where the TCP is, and keeps what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[tuple[str, ...], list[float]]] = []
        self.near: tuple[Any, ...] | None = ()
        self.fails_after = math.inf

    def __call__(self, joints: JointSample) -> Posture:
        if len(self.asked) >= self.fails_after:
            raise UnsafeError("It cannot be computed.")
        self.asked.append((joints.names, joints.position.tolist()))
        known = dict(zip(joints.names, joints.position.tolist(), strict=True))
        return Posture(
            pose=Pose(
                position_m=np.array([known["x"], known["y"], 0.4]),
                quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
            ),
            smallest_singular_value=None,
            near=self.near,
        )

    @property
    def places(self) -> np.ndarray[Any, Any]:
        return np.array([place for _, place in self.asked])


@pytest.fixture
def slide() -> Slide:
    return Slide()


@pytest.fixture
def make(slide: Slide) -> Callable[..., PathLimiter]:
    """A judge of the arm that slides; the limits are keyword arguments."""

    def build(profile: RobotProfile = PROFILE, **limits: Any) -> PathLimiter:
        rules = motion_rules(LimitsConfig.model_validate(SLOW | limits), profile)
        return PathLimiter(rules, profile, slide)

    return build


Make = Callable[..., PathLimiter]


def leg(
    *position: float, names: tuple[str, ...] = ("x", "y"), duration_s: float | None = 100.0,
    velocity: list[float] | None = None, where: str = "",
) -> Leg:  # fmt: skip
    return Leg(
        names=names,
        position=np.array(position),
        duration_s=duration_s,
        velocity=None if velocity is None else np.array(velocity),
        where=where,
    )


def count(*change: float) -> int:
    return Reach(PROFILE).count(("x", "y"), np.abs(np.array(change)))


def test_a_way_is_a_line_in_steps_of_equal_length(make: Make, slide: Slide) -> None:
    make().check([leg(1.5, 1.0)], START)
    steps = count(0.5, 1.0)
    assert steps > 10
    share = np.linspace(0.0, 1.0, steps + 1)[:, np.newaxis]
    np.testing.assert_allclose(slide.places, [1.0, 2.0] + share * [0.5, -1.0])
    assert {names for names, _ in slide.asked} == {("x", "y")}


def test_a_leg_begins_where_the_one_before_has_ended(make: Make, slide: Slide) -> None:
    make().check([leg(1.5, 2.0), leg(1.5, 2.5)], START)
    assert len(slide.asked) == 1 + count(0.5, 0.0) + count(0.0, 0.5)
    middle = slide.places[count(0.5, 0.0)]
    np.testing.assert_allclose(middle, [1.5, 2.0])
    np.testing.assert_allclose(slide.places[-1], [1.5, 2.5])
    assert np.abs(np.diff(slide.places, axis=0)).max() <= 0.5 / count(0.5, 0.0) + 1e-9


def test_joints_that_a_leg_does_not_name_stay(make: Make, slide: Slide) -> None:
    make().check([leg(2.5, names=("y",)), leg(0.5, 3.0, names=("x", "y"))], START)
    assert set(slide.places[: count(0.0, 0.5), 0]) == {1.0}
    np.testing.assert_allclose(slide.places[-1], [0.5, 3.0])
    slide.asked.clear()
    make().check([leg(3.0, 0.5, names=("y", "x"))], START)
    np.testing.assert_allclose(slide.places[-1], [0.5, 3.0])


def test_a_joint_that_nobody_has_measured_is_neither_moved_nor_asked_for(
    make: Make, slide: Slide
) -> None:
    joints = JointSample(names=("y", "finger", "x"), position=np.array([2.0, math.nan, 1.0]))
    make().check([leg(1.1, names=("x",))], joints)
    assert {names for names, _ in slide.asked} == {("y", "x")}
    np.testing.assert_allclose(slide.places[-1], [2.0, 1.1])
    with pytest.raises(LimitError, match="'finger' is not measured") as caught:
        make().check([leg(0.0, names=("finger",))], joints)
    assert caught.value.limit == "kinematics"


def test_a_measurement_with_more_names_than_positions_is_no_start(make: Make) -> None:
    joints = JointSample(names=("x", "y", "finger"), position=np.array([1.0, 2.0]))
    with pytest.raises(ValueError, match="shorter"):
        make().check([leg(1.5, 2.0)], joints)


# The cubic that a driver may take


def cubic(start: Any, end: Any, first: Any, last: Any, steps: int) -> np.ndarray[Any, Any]:
    """The cubic of Hermite between two postures with these slopes, without its start."""
    s = (np.arange(1, steps + 1) / steps)[:, np.newaxis]
    return np.asarray(
        (2 * s**3 - 3 * s**2 + 1) * np.array(start)
        + (s**3 - 2 * s**2 + s) * np.array(first)
        + (-2 * s**3 + 3 * s**2) * np.array(end)
        + (s**3 - s**2) * np.array(last)
    )


def test_a_leg_with_a_velocity_is_walked_on_the_line_and_on_the_cubic(
    make: Make, slide: Slide
) -> None:
    """From rest to 0.2 m/s after 2 s; the second leg begins with that."""
    first = leg(1.5, 2.25, duration_s=2.0, velocity=[0.2, -0.1])
    second = leg(2.0, 2.0, duration_s=4.0, velocity=[0.0, 0.1])
    make(max_speed_m_s=3.0).check([first, second], START)
    places, at = slide.places, 1
    for start, end, before, after, duration_s in (
        ([1.0, 2.0], [1.5, 2.25], [0.0, 0.0], [0.2, -0.1], 2.0),
        ([1.5, 2.25], [2.0, 2.0], [0.2, -0.1], [0.0, 0.1], 4.0),
    ):
        change = np.array(end) - start
        steps = count(*change)
        line = start + (np.arange(1, steps + 1) / steps)[:, np.newaxis] * change
        np.testing.assert_allclose(places[at : at + steps], line, atol=1e-12)
        at += steps
        slopes = np.array(before) * duration_s, np.array(after) * duration_s
        steps = count(*np.abs([change, 1.5 * slopes[0], 1.5 * slopes[1]]).max(axis=0))
        bent = cubic(start, end, *slopes, steps)
        np.testing.assert_allclose(places[at : at + steps], bent, atol=1e-12)
        at += steps
    assert at == len(places)


def test_velocities_of_a_leg_are_those_of_the_joints_it_names(make: Make, slide: Slide) -> None:
    make(max_speed_m_s=3.0).check(
        [leg(2.5, 1.5, names=("y", "x"), duration_s=2.0, velocity=[0.0, 0.3])], START
    )
    steps = count(*np.abs([[0.5, 0.5], [0.9, 0.0]]).max(axis=0))
    bent = cubic([1.0, 2.0], [1.5, 2.5], [0.0, 0.0], [0.6, 0.0], steps)
    np.testing.assert_allclose(slide.places[-steps:], bent, atol=1e-12)


def test_without_a_time_there_is_only_the_line(make: Make, slide: Slide) -> None:
    make().check([leg(1.5, 2.0, duration_s=None, velocity=[0.2, 0.0])], START)
    assert len(slide.asked) == 1 + count(0.5, 0.0)


# How long a way may be


def test_a_way_of_as_many_postures_as_are_judged_passes_and_one_more_is_refused(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = count(0.5, 0.0) + count(0.0, 0.5)
    way = [leg(1.5, 2.0, where="first: "), leg(1.5, 2.5, where="second: ")]
    monkeypatch.setattr(path_limits, "MAX_POSTURES", most)
    make().check(way, START)
    assert make().slowdown(way, START) == 1.0
    monkeypatch.setattr(path_limits, "MAX_POSTURES", most - 1)
    with pytest.raises(LimitError, match="too long to be checked") as caught:
        make().check(way, START)
    assert (caught.value.limit, caught.value.hint) == ("length", "Send it in several calls.")


# Speeds


def test_a_way_at_the_limit_of_speed_passes(make: Make) -> None:
    make().check([leg(2.0, 2.0, duration_s=2.0)], START)
    make().check([leg(2.0, 2.0, duration_s=2.0 / (1.0 + 5e-7))], START)


@pytest.mark.parametrize(
    ("duration_s", "hint"),
    [
        (1.0, "Give it 2 times the time."),
        (1.6, "Give it 1.25 times the time."),
        (1.999, "Give it 1.01 times the time."),
    ],
)
def test_a_way_that_is_too_fast_is_refused_with_the_time_that_it_needs(
    make: Make, duration_s: float, hint: str
) -> None:
    with pytest.raises(LimitError, match=r"^the way: The TCP would move at") as caught:
        make().check([leg(2.0, 2.0, duration_s=duration_s, where="the way: ")], START)
    assert (caught.value.limit, caught.value.hint) == ("speed", hint)


def test_the_fastest_leg_is_told(make: Make) -> None:
    way = [
        leg(1.2, 2.0, duration_s=0.2, where="first: "),
        leg(2.2, 2.0, duration_s=0.5, where="second: "),
        leg(2.5, 2.0, duration_s=0.3, where="third: "),
    ]
    with pytest.raises(LimitError, match=r"^second: The TCP would move at 2 m/s") as caught:
        make().check(way, START)
    assert caught.value.hint == "Give it 4 times the time."
    assert make().slowdown(way, START) == pytest.approx(4.0)


def test_a_way_without_a_time_has_no_speed(make: Make) -> None:
    way = [leg(9.0, 2.0, duration_s=None), leg(1.0, 2.0, duration_s=0.0)]
    make().check(way, START)
    assert make().slowdown(way, START) == 1.0


def test_a_slow_way_needs_no_more_time(make: Make) -> None:
    assert make().slowdown([leg(2.0, 2.0, duration_s=50.0)], START) == 1.0
    assert make().slowdown([], START) == 1.0


def test_only_speeds_slow_a_way_down_not_the_length_of_a_step(make: Make) -> None:
    short = make(max_step_m=0.001)
    assert short.slowdown([leg(2.0, 2.0)], START) == 1.0
    short.check([leg(2.0, 2.0)], START)


# What cannot be judged


def test_a_posture_that_cannot_be_computed_is_refused(make: Make, slide: Slide) -> None:
    for fails_after in (0, 5):
        slide.asked.clear()
        slide.fails_after = fails_after
        with pytest.raises(LimitError, match=r"cannot be checked: It cannot be computed") as caught:
            make().check([leg(2.0, 2.0)], START)
        assert (caught.value.limit, caught.value.hint) == ("kinematics", "")
        assert isinstance(caught.value.__cause__, UnsafeError)
        with pytest.raises(LimitError, match="cannot be checked"):
            make().slowdown([leg(2.0, 2.0)], START)
    slide.fails_after = math.inf
    make().check([leg(2.0, 2.0)], START)


def test_an_arm_whose_links_are_watched_needs_their_distances(make: Make, slide: Slide) -> None:
    watched = replace(PROFILE, collision=CollisionProfile())
    make(watched).check([leg(1.1, 2.0)], START)
    slide.near = None
    make().check([leg(1.1, 2.0)], START)
    with pytest.raises(LimitError, match="reports no distances between links"):
        make(watched).check([leg(1.1, 2.0)], START)


def test_a_way_into_a_zone_names_the_leg_and_the_rule(make: Make) -> None:
    zone = {"name": "pane", "lower_m": [1.4, 1.0, 0.0], "upper_m": [1.6, 3.0, 1.0]}
    with pytest.raises(LimitError, match=r"^second: The TCP would enter 'pane'") as caught:
        make(zones=[zone]).check(
            [leg(1.2, 2.0, where="first: "), leg(2.0, 2.0, where="second: ")], START
        )
    assert caught.value.limit == "zone"
