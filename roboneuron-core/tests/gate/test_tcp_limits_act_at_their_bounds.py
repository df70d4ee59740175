"""Limits of the TCP and of postures at their bounds: just inside, at and just outside; paths in,
through and out.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roboneuron.contract import Obstacle, Pose, Posture, Proximity
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion import MotionRules
from roboneuron.gate.motion.task_space import Motion, TaskSpace, angle_rad, distance_m

UNIT = np.array([0.0, 0.0, 0.0, 1.0])
STILL = Motion(step_m=0.0, step_rad=0.0, speed_m_s=0.0, turn_rad_s=0.0, joint_speed=0.0)
RULES = MotionRules(reactions={})


def pose(*position_m: float, turn_rad: float = 0.0, axis: int = 2) -> Pose:
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = math.sin(turn_rad / 2.0), math.cos(turn_rad / 2.0)
    return Pose(position_m=np.array(position_m or (0.0, 0.0, 0.0)), quaternion_xyzw=quaternion)


def posture(*position_m: float, singular: float | None = None, **near_m: float) -> Posture:
    """A posture in which `a` and the named links have these distances; 10 mm are required."""
    pairs = tuple(
        Proximity(first="a", second=name, distance_m=d, least_m=0.01) for name, d in near_m.items()
    )
    return Posture(pose=pose(*position_m), smallest_singular_value=singular, near=pairs)


def places(rules: MotionRules, start: Posture, end: Posture) -> list[tuple[str, str]]:
    found = TaskSpace(rules).places(start.pose, end, lambda: start)
    return [(one.limit, one.reason) for one in found]


def line(
    rules: MotionRules, start: tuple[float, ...], end: tuple[float, ...]
) -> list[tuple[str, str]]:
    return places(rules, posture(*start), posture(*end))


def test_a_distance_is_the_length_of_the_straight_line() -> None:
    assert distance_m(pose(1.0, 2.0, 3.0), pose(3.0, -1.0, 9.0)) == 7.0


@given(
    first=st.floats(0.0, math.pi),
    second=st.floats(0.0, math.pi),
    axis=st.integers(0, 2),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_an_angle_is_that_of_the_shorter_turn(
    first: float, second: float, axis: int, sign: float
) -> None:
    here, there = pose(turn_rad=first, axis=axis), pose(turn_rad=second, axis=axis)
    same = Pose(position_m=there.position_m, quaternion_xyzw=sign * there.quaternion_xyzw)
    # 1 - cos^2 is rounded
    assert angle_rad(here, same) == pytest.approx(abs(first - second), abs=1e-7)
    opposite = pose(turn_rad=-second, axis=axis)
    turn = first + second
    assert angle_rad(here, opposite) == pytest.approx(min(turn, 2.0 * math.pi - turn), abs=1e-7)


def test_quaternions_a_little_longer_than_one_have_an_angle() -> None:
    long = Pose(position_m=np.zeros(3), quaternion_xyzw=UNIT * (1.0 + 1e-9))
    assert angle_rad(long, long) == 0.0


def test_a_motion_is_measured_from_the_tcp_and_timed_from_the_setpoint() -> None:
    end = Posture(pose=pose(0.5, 0.0, 0.0, turn_rad=0.5), smallest_singular_value=0.25)
    found = TaskSpace(RULES).motion(
        pose(0.2, 0.0, 0.4, turn_rad=0.1), pose(0.1, 0.3, 0.0, turn_rad=-0.5), end, 0.25, 3.0
    )
    assert found.step_m == pytest.approx(0.5)
    assert found.step_rad == pytest.approx(0.4)
    assert found.speed_m_s == pytest.approx(2.0)
    assert found.turn_rad_s == pytest.approx(4.0)
    assert found.joint_speed == 3.0
    assert found.smallest_singular_value == 0.25


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_motion_with_a_number_that_is_not_finite_is_unsafe(bad: float) -> None:
    far = Posture(pose=pose(bad, 0.0, 0.0))
    turned = Posture(
        pose=Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, bad, 1.0]))
    )
    task = TaskSpace(RULES)
    with np.errstate(invalid="ignore"):
        for measured, start, end, speed in (
            (far.pose, pose(), posture(), 0.0),
            (pose(), far.pose, posture(), 0.0),
            (pose(), pose(), far, 0.0),
            (turned.pose, pose(), posture(), 0.0),
            (pose(), turned.pose, posture(), 0.0),
            (pose(), pose(), posture(), bad),
            (pose(), pose(), posture(singular=bad), 0.0),
        ):
            with pytest.raises(UnsafeError, match="not finite"):
                task.motion(measured, start, end, 1.0, speed)


@pytest.mark.parametrize("singular", [None, 0.0, 0.5])
def test_a_motion_may_have_a_singular_value_or_none(singular: float | None) -> None:
    assert TaskSpace(RULES).motion(pose(), pose(), posture(singular=singular), 1.0, 0.0) == replace(
        STILL, smallest_singular_value=singular
    )


@pytest.mark.parametrize(
    ("name", "value", "limit", "unit"),
    [
        ("step", "step_m", "max_step_m", "m"),
        ("step", "step_rad", "max_step_rad", "rad"),
        ("speed", "speed_m_s", "max_speed_m_s", "m/s"),
        ("speed", "turn_rad_s", "max_turn_rad_s", "rad/s"),
    ],
)
def test_a_step_or_speed_is_in_excess_above_its_own_limit(
    name: str, value: str, limit: str, unit: str
) -> None:
    task = TaskSpace(replace(RULES, **{limit: 0.25}))
    for allowed in (0.0, 0.2499, 0.25):
        assert list(task.excess(replace(STILL, **{value: allowed}))) == []
    by = "at " if name == "speed" else ""
    reason = f"The TCP would move {by}0.375 {unit}, allowed is 0.25 {unit}."
    assert list(task.excess(replace(STILL, **{value: 0.375}))) == [(name, 1.5, reason)]
    every = Motion(step_m=9.0, step_rad=9.0, speed_m_s=9.0, turn_rad_s=9.0, joint_speed=9.0)
    assert [times for _, times, _ in task.excess(every)] == [36.0]


BOX = {"lower_m": np.array([-1.0, -2.0, -3.0]), "upper_m": np.array([1.0, 2.0, 3.0])}


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_workspace_ends_at_each_of_its_faces(axis: int, sign: float) -> None:
    rules, at, outside = replace(RULES, **BOX), np.zeros(3), np.zeros(3)
    at[axis], outside[axis] = sign * (axis + 1.0), sign * (axis + 1.25006)
    assert line(rules, (0.0, 0.0, 0.0), tuple(at)) == []
    [(name, reason)] = line(rules, (0.0, 0.0, 0.0), tuple(outside))
    assert name == "workspace"
    assert reason.startswith("The TCP would be 0.2501 m outside the workspace, at [")
    assert f"{sign * (axis + 1.2501):.4f}" in reason, "a tenth of a millimetre is enough"


@pytest.mark.parametrize(
    ("start", "end", "is_broken"),
    [
        ((1.5, 0.0, 0.0), (1.25, 0.0, 0.0), False),
        ((1.5, 0.0, 0.0), (1.5, 0.0, 0.0), True),
        ((1.5, 0.0, 0.0), (1.75, 0.0, 0.0), True),
        ((1.5, 0.0, 0.0), (0.0, 0.0, 0.0), False),
        ((1.5, 0.0, 0.0), (0.0, 2.5, 0.0), True),  # as far outside another face
        ((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), False),
        ((1.0, 0.0, 0.0), (1.001, 0.0, 0.0), True),
    ],
)
def test_outside_of_the_workspace_only_ways_back_are_allowed(
    start: tuple[float, ...], end: tuple[float, ...], is_broken: bool
) -> None:
    assert bool(line(replace(RULES, **BOX), start, end)) == is_broken


@pytest.mark.parametrize(
    ("start_m", "end_m", "is_broken"),
    [
        (1.0, 0.5, False),
        (1.0, 0.499, True),
        (0.5, 0.499, True),
        (0.2, 0.3, False),
        (0.2, 0.2, True),
        (0.2, 0.1, True),
    ],
)
def test_the_tcp_stays_at_its_height_or_rises_to_it(
    start_m: float, end_m: float, is_broken: bool
) -> None:
    found = line(replace(RULES, min_height_m=0.5), (0.0, 0.0, start_m), (9.0, 9.0, end_m))
    reason = f"The TCP would be at a height of {end_m:.4f} m, allowed is 0.5 m."
    assert found == ([("height", reason)] if is_broken else [])


ZONE = Obstacle(name="vase", lower_m=np.array([1.0, 1.0, 1.0]), upper_m=np.array([2.0, 3.0, 5.0]))


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)], ids=str)
@pytest.mark.parametrize(
    ("start", "end", "is_broken"),
    [
        # Along the first axis: before, to the face, in, through, beyond; and in reverse.
        ((0.0, 2.0, 3.0), (0.9, 2.0, 3.0), False),
        ((0.0, 2.0, 3.0), (1.0, 2.0, 3.0), False),
        ((0.0, 2.0, 3.0), (1.1, 2.0, 3.0), True),
        ((0.0, 2.0, 3.0), (9.0, 2.0, 3.0), True),
        ((9.0, 2.0, 3.0), (0.0, 2.0, 3.0), True),
        ((9.0, 2.0, 3.0), (2.1, 2.0, 3.0), False),
        ((9.0, 2.0, 3.0), (1.9, 2.0, 3.0), True),
        ((2.5, 2.0, 3.0), (9.0, 2.0, 3.0), False),
        ((0.9, 2.0, 3.0), (0.0, 2.0, 3.0), False),
        # Outside, and along one of its faces.
        ((0.0, 0.5, 3.0), (9.0, 0.5, 3.0), False),
        ((0.0, 3.5, 3.0), (9.0, 3.5, 3.0), False),
        ((0.0, 1.0, 3.0), (9.0, 1.0, 3.0), False),
        ((0.0, 3.0, 3.0), (9.0, 3.0, 3.0), False),
        ((0.0, 2.0, 0.0), (9.0, 2.0, 0.0), False),
        ((1.5, 0.0, 0.0), (1.5, 9.0, 0.0), False),
        ((1.5, 0.0, 3.0), (1.5, 9.0, 3.0), True),
        # Oblique: past an edge, exactly over it, and through.
        ((0.5, 2.5, 3.0), (1.5, 3.75, 3.0), False),
        ((0.5, 2.5, 3.0), (1.5, 3.5, 3.0), False),
        ((0.5, 2.5, 3.0), (1.5, 3.25, 3.0), True),
        ((0.0, 0.0, 0.0), (3.0, 3.0, 3.0), True),
        # From one of its faces: away, along, in and through.
        ((1.0, 2.0, 3.0), (0.0, 2.0, 3.0), False),
        ((1.0, 2.0, 3.0), (1.0, 2.5, 3.0), False),
        ((1.0, 2.0, 3.0), (1.5, 2.0, 3.0), True),
        ((1.0, 2.0, 3.0), (9.0, 2.0, 3.0), True),
        # From inside: out, towards a face, no motion, deeper in.
        ((1.25, 2.0, 3.0), (0.0, 2.0, 3.0), False),
        ((1.25, 2.0, 3.0), (9.0, 2.0, 3.0), False),
        ((1.25, 2.0, 3.0), (1.125, 2.0, 3.0), False),
        ((1.25, 2.0, 3.0), (1.25, 2.0, 3.0), True),
        ((1.25, 2.0, 3.0), (1.5, 2.0, 3.0), True),
        ((1.25, 2.0, 3.0), (1.75, 2.0, 3.0), True),  # as deep, at the other face
    ],
)
def test_a_line_enters_a_zone_where_it_passes_within_it(
    axes: tuple[int, int, int], start: tuple[float, ...], end: tuple[float, ...], is_broken: bool
) -> None:
    order = list(axes)
    zone = Obstacle(name="vase", lower_m=ZONE.lower_m[order], upper_m=ZONE.upper_m[order])
    other = Obstacle(name="far", lower_m=np.full(3, 50.0), upper_m=np.full(3, 51.0))
    found = line(
        replace(RULES, zones=(other, zone)),
        tuple(np.array(start)[order]),
        tuple(np.array(end)[order]),
    )
    assert [name for name, _ in found] == ["zone"] * is_broken
    told = f"The TCP would enter 'vase' on its way to {np.array(end)[order].tolist()} m"
    assert all(reason.startswith(told) for _, reason in found)


def test_a_way_that_ends_in_a_zone_tells_how_deep() -> None:
    rules, (low, high) = replace(RULES, zones=(ZONE,)), (ZONE.lower_m, ZONE.upper_m)
    end = (low + high) / 2.0
    end[0] = low[0] + 0.0123
    start = end.copy()
    start[0] = low[0] - 1.0
    (found,) = TaskSpace(rules).places(pose(*start), posture(*end), lambda: posture(*start))
    assert found.depth == pytest.approx(0.0123)
    assert "13 mm deep" in found.reason


def test_the_end_of_a_way_into_a_zone_is_given_in_tenths_of_a_millimetre() -> None:
    [(_, reason)] = line(replace(RULES, zones=(ZONE,)), (0.0, 2.0, 3.0), (1.23456, 2.0, 3.0))
    assert "[1.2346, 2.0, 3.0]" in reason


@pytest.mark.parametrize(
    ("start", "end", "is_broken"),
    [
        (0.5, 0.1, False),
        (0.5, 0.0999, True),
        (0.1, 0.05, True),
        (0.05, 0.06, False),
        (0.05, 0.05, True),
        (0.05, 0.04, True),
        (0.0, 0.01, False),
        (None, 0.05, False),  # the start is unknown: any value is better
        (None, 0.0, True),
        (0.0, 0.0, True),
        (0.5, None, False),
    ],
)
def test_the_arm_keeps_away_from_singularities_or_leaves_them(
    start: float | None, end: float | None, is_broken: bool
) -> None:
    found = places(
        replace(RULES, min_singular_value=0.1), posture(singular=start), posture(singular=end)
    )
    assert [name for name, _ in found] == (["singularity"] if is_broken else [])
    if is_broken:
        assert found[0][1] == f"The smallest singular value would be {end:.4f}, allowed is 0.1."


@pytest.mark.parametrize(
    ("start", "end", "broken"),
    [
        ({}, {"b": 0.009}, ["b"]),
        ({}, {"b": 0.01}, ["b"]),  # a controller only names pairs that are too near
        ({}, {"b": 0.011}, []),
        ({"b": 0.005}, {"b": 0.006}, []),
        ({"b": 0.005}, {"b": 0.005}, ["b"]),
        ({"b": 0.005}, {"b": 0.004}, ["b"]),
        ({"b": -0.002}, {"b": -0.001}, []),
        ({"b": 0.005}, {"b": 0.006, "c": 0.006}, ["c"]),
        ({"b": 0.005, "c": 0.001}, {"b": 0.004, "c": 0.0}, ["b", "c"]),
        ({"b": 0.005}, {}, []),
    ],
)
def test_bodies_that_are_too_near_may_only_part(
    start: dict[str, float], end: dict[str, float], broken: list[str]
) -> None:
    found = places(RULES, posture(**start), posture(**end))
    assert found == [
        (
            "collision",
            f"a and {name} would be {end[name] * 1e3:.1f} mm apart, at least 10 mm are required.",
        )
        for name in broken
    ]


def test_nearness_that_is_not_known_at_the_start_is_none_there() -> None:
    start = Posture(pose=pose(), near=None)
    assert places(RULES, start, start) == []
    assert [name for name, _ in places(RULES, start, posture(b=0.005))] == ["collision"]


def test_the_posture_at_the_start_is_asked_for_only_when_it_matters() -> None:
    asked: list[int] = []

    def look() -> Posture:
        asked.append(1)
        return posture(singular=0.01, b=0.001)

    task = TaskSpace(replace(RULES, min_singular_value=0.1))
    assert list(task.places(pose(), posture(singular=0.2), look)) == []
    assert list(task.places(pose(), posture(singular=0.1), look)) == []
    assert list(task.places(pose(), posture(), look)) == []
    assert asked == []
    assert list(task.places(pose(), posture(singular=0.05, b=0.005), look)) == []
    assert asked == [1, 1]


def test_every_broken_limit_of_place_is_named() -> None:
    rules = replace(
        RULES,
        **BOX,
        min_height_m=0.0,
        zones=(ZONE, replace(ZONE, name="pot")),
        min_singular_value=0.1,
    )
    found = places(rules, posture(0.0, 0.0, 0.5), posture(3.0, 3.0, -0.5, singular=0.0, b=0.0))
    assert [name for name, _ in found] == ["workspace", "height", "singularity", "collision"]
    through = line(rules, (0.0, 0.0, 0.0), (1.5, 1.5, 1.5))
    assert [name for name, _ in through] == ["workspace", "zone", "zone"]
