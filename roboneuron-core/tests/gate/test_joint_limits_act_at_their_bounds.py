"""Joint limits at their bounds: just inside, exactly at, just outside; with hand-computed
numbers.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from roboneuron.contract import GripperProfile, JointLimits, RobotProfile
from roboneuron.gate.motion import MotionRules
from roboneuron.gate.motion.acceleration import JointAccelerations
from roboneuron.gate.motion.joint_space import (
    JointLimit,
    JointSpace,
    braking_velocity,
)

NAMES = ("a", "b")


def space(*limits: JointLimit) -> JointSpace:
    return JointSpace(NAMES[: len(limits)], limits)


def accelerations(*limits: JointLimit) -> JointAccelerations:
    return JointAccelerations(NAMES[: len(limits)], limits)


def violations(
    limit: JointLimit, start: float, change: float, step_s: float = 1.0
) -> list[tuple[str, float, str]]:
    return list(space(limit).violations(np.array([start]), np.array([change]), step_s))


@pytest.mark.parametrize(
    ("distance", "offset", "deceleration", "step_s", "fastest"),
    [
        (1.0, 0.0, 2.0, 0.0, 2.0),  # v^2 = 2 a s
        (1.0, 0.5, 2.0, 0.0, 1.5),  # 0.5 rad/s in reserve
        # 0.5 rad in the step; in the other 0.5 it brakes from 2, minus 1 in reserve
        (1.0, 1.0, 4.0, 0.5, 1.0),
        (0.0, 0.0, 2.0, 0.0, 0.0),
        (0.0, 0.1, 2.0, 0.0, 0.0),
        (-0.1, 0.1, 2.0, 0.0, 0.0),
        (-5.0, 0.1, 2.0, 0.5, 0.0),
    ],
)
def test_braking_velocity_is_that_of_even_deceleration_to_the_limit(
    distance: float, offset: float, deceleration: float, step_s: float, fastest: float
) -> None:
    assert braking_velocity(distance, offset, deceleration, step_s) == pytest.approx(fastest)


def test_a_braking_velocity_that_may_change_at_once_is_asked_for_without_a_step() -> None:
    assert braking_velocity(1.0, 0.5, 2.0) == pytest.approx(1.5)
    assert JointLimit(lower=0.0, upper=1.0, braking=(0.5, 2.0)).fastest(0.0, True) == pytest.approx(
        1.5
    )


@pytest.mark.parametrize(
    ("value", "is_allowed"),
    [
        *((-3.0, True), (-3.0 - 2.9e-6, True), (-3.0 - 3.1e-6, False)),
        *((0.5, True), (0.5 + 0.9e-6, True), (0.5 + 1.1e-6, False)),
        *((0.0, True), (math.nan, False), (math.inf, False), (-math.inf, False)),
    ],
)
def test_the_slack_of_a_position_is_a_millionth_of_its_bound_or_of_one(
    value: float, is_allowed: bool
) -> None:
    assert JointLimit(lower=-3.0, upper=0.5).allows("position", value) is is_allowed
    assert JointLimit(lower=-0.5, upper=3.0).allows("position", -value) is is_allowed


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_slack_itself_is_allowed(sign: float) -> None:
    assert JointLimit(lower=0.0, upper=0.0).allows("position", sign * 1e-6)


@pytest.mark.parametrize("quantity", ["velocity", "acceleration", "effort"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_rate_or_an_effort_is_limited_both_ways(quantity: str, sign: float) -> None:
    limit = replace(JointLimit(lower=-9.0, upper=9.0), **{quantity: 2.0})
    assert limit.range(quantity) == (-2.0, 2.0)
    assert limit.allows(quantity, sign * 2.0)
    assert not limit.allows(quantity, sign * 2.00001)


def test_the_range_of_a_position_is_from_its_lower_to_its_upper_bound() -> None:
    assert JointLimit(lower=-1.0, upper=2.0, velocity=5.0).range("position") == (-1.0, 2.0)


def test_a_joint_without_braking_is_as_fast_everywhere() -> None:
    limit = JointLimit(lower=-1.0, upper=1.0, velocity=2.0)
    assert limit.fastest(0.999, True, 0.5) == limit.fastest(-0.999, False) == 2.0


def test_a_joint_that_brakes_is_slower_towards_the_nearer_limit() -> None:
    limit = JointLimit(lower=-1.0, upper=7.0, velocity=2.5, braking=(1.0, 2.0))
    assert limit.fastest(0.0, False) == pytest.approx(1.0)  # sqrt(2 * 2 * 1) - 1
    assert limit.fastest(6.0, True) == pytest.approx(1.0)
    assert limit.fastest(0.0, True) == 2.5  # sqrt(2 * 2 * 7) - 1 = 4.3
    assert limit.fastest(6.0, False) == 2.5


@pytest.mark.parametrize(("acceleration", "fastest"), [(4.0, 1.0), (100.0, math.sqrt(40.0) - 5.0)])
def test_a_joint_brakes_after_a_step_no_harder_than_commands_may_ask(
    acceleration: float, fastest: float
) -> None:
    limit = JointLimit(lower=0.0, upper=1.0, acceleration=acceleration, braking=(1.0, 8.0))
    assert limit.fastest(0.0, True, 0.5) == pytest.approx(fastest)
    assert limit.fastest(0.0, True) == pytest.approx(3.0), (
        "the bound at this very position is the robot's own"
    )


LIMITS = JointLimits(
    lower=np.array([-1.0, -2.0]),
    upper=np.array([3.0, 4.0]),
    velocity=np.array([5.0, 6.0]),
    acceleration=np.array([7.0, 8.0]),
    effort=np.array([9.0, 10.0]),
)
PROFILE = RobotProfile(name="arm", arm_joints=NAMES, limits=LIMITS)


def test_limits_come_from_the_profile_joint_by_joint() -> None:
    found = JointLimit.by_joint(PROFILE)
    assert found == {
        "a": JointLimit(lower=-1.0, upper=3.0, velocity=5.0, acceleration=7.0, effort=9.0),
        "b": JointLimit(lower=-2.0, upper=4.0, velocity=6.0, acceleration=8.0, effort=10.0),
    }


def test_rules_take_their_shares_of_velocity_and_acceleration_alone() -> None:
    rules = MotionRules(reactions={}, velocity_fraction=0.5, acceleration_fraction=0.25)
    found = JointLimit.by_joint(PROFILE, rules)["b"]
    assert found == JointLimit(lower=-2.0, upper=4.0, velocity=3.0, acceleration=2.0, effort=10.0)


def test_braking_needs_both_of_its_numbers() -> None:
    offset, deceleration = np.array([0.1, 0.2]), np.array([3.0, 4.0])
    both = replace(LIMITS, braking_offset=offset, braking_deceleration=deceleration)
    assert JointLimit.by_joint(replace(PROFILE, limits=both))["b"].braking == (0.2, 4.0)
    for one in (replace(both, braking_offset=None), replace(both, braking_deceleration=None)):
        assert JointLimit.by_joint(replace(PROFILE, limits=one))["b"].braking is None


@pytest.mark.parametrize(("closed", "opened"), [(0.0, 0.04), (0.8, 0.1)])
def test_a_gripper_is_limited_to_its_travel_whichever_end_is_closed(
    closed: float, opened: float
) -> None:
    gripper = GripperProfile(joint="finger", closed_position=closed, open_position=opened)
    found = JointLimit.by_joint(RobotProfile(name="gripper", gripper=gripper))
    assert found == {"finger": JointLimit(lower=min(closed, opened), upper=max(closed, opened))}


def test_a_robot_without_limits_and_gripper_has_none() -> None:
    assert JointLimit.by_joint(RobotProfile(name="arm", arm_joints=NAMES)) == {}


@pytest.mark.parametrize(
    ("start", "change", "share"),
    [
        *((1.0, 2.0, 0.5), (1.0, 1.0, None), (0.0, -4.0, 0.75), (0.0, -3.0, None)),
        *((1.0, 1.0 + 1.9e-6, None), (1.0, 1.0 + 2.1e-6, 1.0)),
        *((-2.0, -1.0 - 2.9e-6, None), (-2.0, -1.0 - 3.1e-6, 1.0)),
        # Outside: not farther, but any way back, even beyond the other end.
        *(
            (2.5, 0.1, 0.0),
            (2.5, -0.1, None),
            (2.5, -5.5, None),
            (2.5, -6.5, 5.5 / 6.5),
            (-3.5, 0.1, None),
        ),
        *((-3.5, -0.1, 0.0), (2.5, 0.0, None), (-3.5, 0.0, None)),
    ],
)
def test_a_change_is_shortened_to_the_position_limit_that_it_passes(
    start: float, change: float, share: float | None
) -> None:
    found = violations(JointLimit(lower=-3.0, upper=2.0), start, change)
    if share is None:
        assert found == []
        return
    [(name, allowed, reason)] = found
    assert name == "position"
    assert allowed == pytest.approx(share, abs=1e-5)
    assert reason == f"a would go to {start + change:.4f}, beyond its limits."


def test_the_slack_of_a_position_within_one_is_a_millionth() -> None:
    for sign in (-1.0, 1.0):
        assert violations(JointLimit(lower=-0.5, upper=0.5), 0.0, sign * (0.5 + 0.9e-6)) == []
        assert violations(JointLimit(lower=-0.5, upper=0.5), 0.0, sign * (0.5 + 1.1e-6)) != []


def test_the_slack_of_a_change_is_that_of_the_bound_which_it_passes() -> None:
    for change, is_named in ((0.5 + 0.9e-6, False), (0.5 + 1.1e-6, True)):
        assert bool(violations(JointLimit(lower=-3.0, upper=0.5), 0.0, change)) is is_named
        assert bool(violations(JointLimit(lower=-0.5, upper=3.0), 0.0, -change)) is is_named


def test_a_change_may_take_up_the_slack_itself() -> None:
    for sign in (-1.0, 1.0):
        assert violations(JointLimit(lower=0.0, upper=0.0), 0.0, sign * 1e-6) == []
        assert violations(JointLimit(velocity=1.0 - 1e-6), 0.0, sign) == []


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("change", "step_s", "share"),
    [
        (1.0, 0.5, None),
        (2.0, 0.5, 0.5),
        (1.0, 0.25, 0.5),
        (1.0 + 0.9e-6, 0.5, None),
        (1.0 + 1.1e-6, 0.5, 1.0),
    ],
)
def test_a_change_is_shortened_to_the_velocity_limit(
    sign: float, change: float, step_s: float, share: float | None
) -> None:
    found = violations(JointLimit(velocity=2.0), 0.0, sign * change, step_s)
    assert [name for name, _, _ in found] == ([] if share is None else ["velocity"])
    if share is not None:
        assert found[0][1] == pytest.approx(share, abs=1e-5)
        assert found[0][2] == f"a would move at {change / step_s:.4g} per second, allowed is 2."


def test_the_velocity_of_a_whole_step_is_one_that_can_be_braked_after_it() -> None:
    limit = JointLimit(lower=-9.0, upper=1.0, velocity=50.0, acceleration=4.0, braking=(1.0, 8.0))
    [(name, share, _)] = violations(limit, 0.0, 0.8, 0.5)  # at most 1 rad/s, so 0.5 rad
    assert (name, share) == ("velocity", pytest.approx(0.625))
    assert violations(limit, 0.0, -0.8, 0.5) == [], "the other limit is far away"


@pytest.mark.parametrize(("change", "is_named"), [(1e-10, False), (1e-9, False), (1e-8, True)])
def test_rounding_is_no_motion_towards_a_limit_that_allows_none(
    change: float, is_named: bool
) -> None:
    limit = JointLimit(lower=0.0, upper=1.0, braking=(0.1, 1.0))
    assert bool(violations(limit, 1.0, change)) == is_named


@pytest.mark.parametrize("nearer", [0, 1])
def test_the_joint_that_allows_least_decides(nearer: int) -> None:
    limits = [JointLimit(lower=-1.0, upper=1.0, velocity=1.0)] * 2
    change = np.array([2.0, 2.0])
    change[nearer] = 4.0
    found = list(space(*limits).violations(np.zeros(2), change, 1.0))
    assert [(name, share) for name, share, _ in found] == [("position", 0.25), ("velocity", 0.25)]
    assert all(reason.startswith(f"{NAMES[nearer]} would ") for _, _, reason in found)


def test_of_joints_that_allow_the_same_the_first_is_named() -> None:
    found = space(*[JointLimit(lower=-1.0, upper=1.0, velocity=1.0)] * 2).violations(
        np.zeros(2), np.full(2, -2.0), 1.0
    )
    assert [reason[:8] for _, _, reason in found] == ["a would ", "a would "]


def test_a_joint_that_rests_does_not_hide_one_that_moves() -> None:
    limits = [JointLimit(lower=-1.0, upper=1.0)] * 2
    [(name, share, _)] = space(*limits).violations(np.array([5.0, 0.0]), np.array([0.0, 2.0]), 1.0)
    assert (name, share) == ("position", 0.5)


def reach(
    before: list[float], wanted: list[float], acceleration: float = 4.0
) -> tuple[list[float], str]:
    """After 0.25 s, 4 rad/s^2 give 1 rad/s."""
    limits = [JointLimit(acceleration=acceleration)] * len(before)
    velocity, joint = accelerations(*limits).nearest_velocity(
        np.array(before), np.array(wanted), 0.25
    )
    return velocity.tolist(), joint


@pytest.mark.parametrize(
    ("before", "wanted", "velocity", "joint"),
    [
        # Within reach.
        ([0.0, 0.0], [1.0, -1.0], [1.0, -1.0], ""),
        ([1.0, -1.0], [0.0, 0.0], [0.0, 0.0], ""),
        # A share of the requested change, in the same direction.
        ([0.0, 0.0], [2.0, 1.0], [1.0, 0.5], "a"),
        ([0.0, 0.0], [-1.0, -4.0], [-0.25, -1.0], "b"),
        ([0.0, 0.0], [2.0, -2.0], [1.0, -1.0], "a"),
        ([0.5, 0.0], [3.0, 1.0], [1.5, 0.5], "a"),
        ([0.0, 0.5], [0.0, 3.0], [0.0, 1.5], "b"),
        ([0.0, -0.5], [1.0, -3.0], [0.5, -1.5], "b"),
        ([0.5, 0.0], [-2.0, 0.0], [-0.5, 0.0], "a"),
        ([1.0, 0.0], [0.0, 2.0], [0.0, 1.0], "b"),
        ([2.0, 0.0], [2.0, 2.0], [1.0, 1.0], "b"),
        # No share is within reach: between the current velocity and the requested one.
        ([2.0, 0.0], [0.0, 0.0], [1.0, 0.0], "a"),
        ([2.0, 0.0], [0.0, 2.0], [1.0, 1.0], "a"),
        ([1.5, 0.0], [0.25, 0.0], [0.5, 0.0], "a"),
        ([-2.0, 0.0], [2.0, 1.0], [-1.0, 0.25], "a"),
        ([0.0, -2.0], [0.5, 2.0], [0.125, -1.0], "b"),
        ([-3.0, 1.0], [-1.0, 1.0], [-2.0, 1.0], "a"),
        ([3.0, 1.0], [1.0, 1.0], [2.0, 1.0], "a"),
    ],
)
def test_a_velocity_is_reached_as_far_as_acceleration_allows(
    before: list[float], wanted: list[float], velocity: list[float], joint: str
) -> None:
    found, name = reach(before, wanted)
    assert found == pytest.approx(velocity, abs=1e-12)
    assert name == joint


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("change", "can"), [(1.0, True), (1.0 + 1.9e-6, True), (1.0 + 2.1e-6, False), (3.0, False)]
)
def test_the_slack_of_an_acceleration_is_two_millionths(
    sign: float, change: float, can: bool
) -> None:
    joints = accelerations(JointLimit(acceleration=4.0))
    assert (
        joints.is_reachable(np.array([sign * 0.5]), np.array([sign * (0.5 + change)]), 0.25) is can
    )
    assert (
        joints.is_reachable(np.array([sign * 0.5]), np.array([sign * (0.5 - change)]), 0.25) is can
    )


def test_in_no_time_a_velocity_only_stays_as_it_is() -> None:
    joints = accelerations(JointLimit(acceleration=4.0))
    for change, can in ((0.0, True), (1e-12, True), (2e-12, False)):
        assert joints.is_reachable(np.zeros(1), np.array([change]), 0.0) is can


def test_every_joint_has_to_reach_its_velocity() -> None:
    joints = accelerations(JointLimit(acceleration=4.0), JointLimit(acceleration=8.0))
    assert joints.is_reachable(np.zeros(2), np.array([1.0, 2.0]), 0.25)
    assert not joints.is_reachable(np.zeros(2), np.array([2.0, 1.0]), 0.25)
    assert not joints.is_reachable(np.zeros(2), np.array([1.0, 2.5]), 0.25)


@pytest.mark.parametrize(("first", "second"), [(1, 2), (2, 1)])
def test_no_joint_is_left_unchecked_when_arrays_are_too_short(first: int, second: int) -> None:
    limits = [JointLimit()] * 2
    with pytest.raises(ValueError, match="zip"):
        list(space(*limits).violations(np.zeros(first), np.zeros(second), 1.0))
    with pytest.raises(ValueError, match="zip"):
        accelerations(*limits).is_reachable(np.zeros(first), np.zeros(second), 1.0)
