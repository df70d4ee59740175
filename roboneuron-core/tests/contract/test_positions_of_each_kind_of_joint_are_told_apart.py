"""Differences of positions, the nearest of equal ones, and followers, by kind of joint."""

from __future__ import annotations

import math

import numpy as np
import pytest

from roboneuron.contract import TURN, JointKinds
from roboneuron.errors import ConfigurationError

PI, INF = math.pi, math.inf
KINDS = ("revolute", "continuous", "prismatic")


def urdf(*joints: str) -> str:
    return f'<robot name="r">{"".join(joints)}</robot>'


def joint(name: str, kind: str, inside: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="a"/><child link="b"/>{inside}</joint>'


def mimic(leader: str, **numbers: object) -> str:
    told = "".join(f' {key}="{value}"' for key, value in numbers.items())
    return f'<mimic joint="{leader}"{told}/>'


ALL = JointKinds.of(urdf(*(joint(kind, kind) for kind in KINDS), joint("weld", "fixed")))


@pytest.mark.parametrize(
    ("start", "end", "shorter"),
    [
        (0.0, 0.1, 0.1),
        (PI - 0.01, -PI + 0.01, 0.02),
        (-PI + 0.01, PI - 0.01, -0.02),
        (0.1, 0.1 + TURN, 0.0),
        (-20.0, -20.0 + 5 * TURN + 0.3, 0.3),
        (0.0, 4.0, 4.0 - TURN),
        (7.0, 7.2, 0.2),
    ],
)
def test_only_a_continuous_joint_takes_the_shorter_way(
    start: float, end: float, shorter: float
) -> None:
    assert ALL.difference("continuous", start, end) == pytest.approx(shorter)
    for other in ("revolute", "prismatic", "gripper"):
        assert ALL.difference(other, start, end) == end - start
    many = ALL.span(KINDS).difference(np.full(3, start), np.full(3, end))
    assert many == pytest.approx([end - start, shorter, end - start])


@pytest.mark.parametrize(
    ("start", "goal", "lower", "upper", "near"),
    [
        (3.1, -3.1, -INF, INF, -3.1 + TURN),
        (-3.1, 3.1, -INF, INF, 3.1 - TURN),
        (20.0, 0.5, -INF, INF, 0.5 + 3 * TURN),
        (2.9, -2.9, -3.0, 3.0, -2.9),  # the shorter way leads beyond the limits
        (3.1, -3.1, -TURN, TURN, -3.1 + TURN),
        (9.0, 0.0, -TURN, TURN, TURN),  # measured beyond the limits: the nearest within
        (3.1, -3.1, -INF, 3.12, -3.1),
        (0.0, 7.0, -3.0, 3.0, 7.0 - TURN),
        (0.0, 3.5, 3.2, 3.6, 3.5),
        (0.0, 1.0, 2.0, 3.0, 1.0),  # the limits contain none: it is refused as it was written
        (0.3, 0.3, -3.0, 3.0, 0.3),
    ],
)
def test_a_goal_is_taken_in_the_turns_that_are_nearest_within_the_limits(
    start: float, goal: float, lower: float, upper: float, near: float
) -> None:
    assert ALL.nearest("continuous", start, goal, lower, upper) == pytest.approx(near)
    assert ALL.nearest("revolute", start, goal, lower, upper) == goal
    ends = np.full(3, lower), np.full(3, upper)
    many = ALL.span(KINDS).nearest(np.full(3, start), np.full(3, goal), *ends)
    assert many == pytest.approx([goal, near, goal])


@pytest.mark.parametrize("bad", [math.nan, INF, -INF])
def test_what_is_no_position_stays_what_it_is(bad: float) -> None:
    assert not math.isfinite(ALL.difference("continuous", 0.0, bad))
    assert not math.isfinite(ALL.nearest("continuous", 0.0, bad))
    assert ALL.nearest("continuous", bad, 1.0) == 1.0


FOLLOWERS = JointKinds.of(
    urdf(
        joint("third", "revolute", mimic("second", multiplier=3)),  # before what it follows
        joint("first", "continuous"),
        joint("second", "prismatic", mimic("first", multiplier=-2, offset=0.5)),
        joint("late", "prismatic", '<limit lower="0.2" upper="0.4"/>'),
    )
)


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ({}, {"third": 1.5, "first": 0.0, "second": 0.5, "late": 0.2}),
        ({"first": 7.0}, {"third": -40.5, "first": 7.0, "second": -13.5, "late": 0.2}),
        # the leader knows better than a follower that was measured before it moved
        ({"second": 9.0, "first": 1.0}, {"third": -4.5, "first": 1.0, "second": -1.5, "late": 0.2}),
        # without the leader each is where it is measured
        ({"third": 0.1}, {"third": 0.1, "first": 0.0, "second": 0.5, "late": 0.2}),
        ({"wheel": 5.0, "late": 0.3}, {"third": 1.5, "first": 0.0, "second": 0.5, "late": 0.3}),
    ],
)
def test_followers_are_where_their_leader_puts_them(
    told: dict[str, float], expected: dict[str, float]
) -> None:
    for order in (tuple(expected), tuple(reversed(expected)), ("third", "late")):
        found = FOLLOWERS.configuration(order).of(told)
        assert dict(zip(order, found.tolist(), strict=True)) == pytest.approx(
            {name: expected[name] for name in order}
        )


def test_messages_of_other_orders_are_read_by_name() -> None:
    configuration = FOLLOWERS.configuration(("first", "late"))
    for names, values in ((("late", "first"), [0.3, 1.0]), (("first", "x", "late"), [1, 9, 0.3])):
        assert configuration(names, np.array(values)).tolist() == [1.0, 0.3]


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ([joint("a", "revolute", mimic("b"))], "'b', which is no joint that moves"),
        ([joint("a", "revolute", mimic("b")), joint("b", "fixed")], "'b', which is no joint"),
        ([joint("a", "revolute", mimic("a"))], "'a' mimics itself"),
        (
            [joint("a", "revolute", mimic("b")), joint("b", "prismatic", mimic("a"))],
            "'a' mimics itself",
        ),
        (
            [joint("a", "revolute"), joint("b", "revolute", mimic("a", multiplier="twice"))],
            "'b': multiplier of its mimic is 'twice', expected a number",
        ),
        (
            [joint("a", "revolute"), joint("b", "revolute", mimic("a", offset="nan"))],
            "'b': offset of its mimic is 'nan'",
        ),
    ],
)
def test_a_follower_of_nothing_is_named(joints: list[str], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        JointKinds.of(urdf(*joints)).configuration()


def test_a_description_that_is_none_has_no_joints() -> None:
    assert JointKinds.of("no xml").moving == ()
    assert JointKinds.of("").configuration().of({"a": 1.0}).tolist() == []
