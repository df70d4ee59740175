"""Sampling of paths: no point of the arm moves farther between two postures than the spacing."""

from __future__ import annotations

import numpy as np
import pytest

from roboneuron.contract import CollisionProfile, RobotProfile
from roboneuron.gate.motion.path import Reach, levers_m

URDF = """<robot name="arm">
  <joint name="stand" type="fixed"><origin xyz="9 9 9"/><parent link="world"/><child link="base"/></joint>
  <joint name="shoulder" type="revolute"><origin xyz="0 0 0.7"/><parent link="base"/><child link="l1"/></joint>
  <joint name="slide" type="prismatic">
    <origin xyz="0 0 0.25"/><parent link="l1"/><child link="l2"/><limit lower="-0.125" upper="0.375"/>
  </joint>
  <joint name="wrist" type="revolute"><origin xyz="0.3 0 -0.4"/><parent link="l2"/><child link="l3"/></joint>
  <joint name="finger" type="prismatic"><origin xyz="5 0 0"/><parent link="l3"/><child link="l4"/></joint>
  <joint name="flange" type="fixed"><origin xyz="0 0.2 0"/><parent link="l3"/><child link="tcp"/></joint>
</robot>"""  # noqa: E501


def robot(urdf: str = URDF, min_distance_m: float | None = None) -> RobotProfile:
    collision = None if min_distance_m is None else CollisionProfile(min_distance_m=min_distance_m)
    return RobotProfile(
        name="arm", urdf=urdf, base_link="base", tcp_link="tcp", collision=collision
    )


def test_a_lever_is_the_way_along_the_links_from_a_joint_to_the_tcp_and_a_hand_more() -> None:
    assert levers_m(robot()) == pytest.approx(
        {
            "flange": 0.1,
            "wrist": 0.1 + 0.2,
            "slide": 1.0,
            "shoulder": 0.1 + 0.2 + 0.5 + 0.25 + 0.375,  # the slide may be fully extended
        }
    )


@pytest.mark.parametrize(
    ("limit", "travel_m"),
    [
        ("", 1.0),
        ('<limit effort="1"/>', 1.0),
        ('<limit lower="0"/>', 1.0),
        ('<limit lower="-1.5"/>', 1.5),
        ('<limit upper="0.5"/>', 1.0),
        ('<limit lower="0.6" upper="0.9"/>', 0.9),
        ('<limit lower="-0.9" upper="-0.6"/>', 0.9),
    ],
)
def test_a_slide_counts_as_far_as_it_can_be_from_its_zero_or_one_metre(
    limit: str, travel_m: float
) -> None:
    urdf = URDF.replace('<limit lower="-0.125" upper="0.375"/>', limit)
    assert levers_m(robot(urdf))["shoulder"] == pytest.approx(1.05 + travel_m)


def test_a_joint_moves_what_its_followers_move() -> None:
    """The shoulder's lever, and twice the wrist's and three times the slide's."""
    urdf = URDF.replace(
        '<joint name="wrist" type="revolute">',
        '<joint name="wrist" type="revolute"><mimic joint="shoulder" multiplier="-2"/>',
    ).replace(
        '<joint name="slide" type="prismatic">',
        '<joint name="slide" type="prismatic"><mimic joint="wrist" multiplier="1.5"/>',
    )
    assert levers_m(robot(urdf))["shoulder"] == pytest.approx(1.425 + 2.0 * 0.3 + 3.0 * 1.0)


@pytest.mark.parametrize("origin", ["", "<origin/>", '<origin rpy="1 2 3"/>'])
def test_a_joint_that_does_not_say_where_it_is_lies_at_the_one_before(origin: str) -> None:
    assert levers_m(robot(URDF.replace('<origin xyz="0 0 0.25"/>', origin)))[
        "shoulder"
    ] == pytest.approx(1.175)


@pytest.mark.parametrize(
    "urdf",
    [
        "",
        "<robot",
        "<robot/>",
        '<robot><joint name="a"><child link="elsewhere"/></joint></robot>',
        '<robot><joint name="a"><parent link="tcp"/></joint></robot>',
    ],
)
def test_a_description_without_the_chain_has_no_levers(urdf: str) -> None:
    assert levers_m(robot(urdf)) == {}


@pytest.mark.parametrize("parent", ["", "<parent/>", '<parent link="nowhere"/>'])
def test_a_chain_that_does_not_come_to_the_base_is_taken_as_far_as_it_goes(parent: str) -> None:
    assert set(levers_m(robot(URDF.replace('<parent link="l2"/>', parent)))) == {"flange", "wrist"}


def test_links_in_a_ring_are_passed_once() -> None:
    ring = URDF.replace('<parent link="base"/>', '<parent link="tcp"/>')
    assert set(levers_m(robot(ring))) == {"flange", "wrist", "slide", "shoulder"}


@pytest.mark.parametrize(
    ("min_distance_m", "count"),
    [
        (None, 50),
        (0.005, 100),
        (0.001, 200),
        (0.0, 200),
        (0.0025, 200),
        (0.01, 50),
        (0.05, 50),
        (0.0075, 67),
    ],
)
def test_the_spacing_is_twice_the_least_distance_within_5_and_20_mm(
    min_distance_m: float | None, count: int
) -> None:
    assert (
        Reach(robot(min_distance_m=min_distance_m)).count(("slide",), np.array([0.9999])) == count
    )


@pytest.mark.parametrize(
    ("names", "change", "count"),
    [
        (("slide",), [0.0], 1),
        (("slide",), [0.019], 1),
        (("slide",), [0.021], 2),
        (("wrist",), [1.03], 16),  # 0.309 m
        (("wrist", "slide"), [1.0, 0.11], 21),  # 0.3 m and 0.11 m
        (("elbow",), [0.21], 11),  # unknown bodies: 1 m
    ],
)
def test_a_path_is_cut_so_that_no_point_moves_farther_than_the_spacing(
    names: tuple[str, ...], change: list[float], count: int
) -> None:
    assert Reach(robot()).count(names, np.array(change)) == count


def test_a_change_for_every_joint_is_needed() -> None:
    with pytest.raises(ValueError, match="zip"):
        Reach(robot()).count(("wrist", "slide"), np.array([0.1]))
