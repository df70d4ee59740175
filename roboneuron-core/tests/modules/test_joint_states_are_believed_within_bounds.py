"""Joint states that control accepts; all others are refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from roboneuron.contract import JointLimits, JointSample, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, UnsafeError
from roboneuron.modules.joint_watch import JointWatch

S_NS = 1_000_000_000
START_NS = 50 * S_NS
START_S = 7.0
TIMEOUT_S = 0.25
ARM = ("lift", "turn")
URDF = """<robot name="pair">
  <link name="base"/><link name="one"/><link name="two"/>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="one"/></joint>
  <joint name="turn" type="revolute"><parent link="one"/><child link="two"/></joint>
</robot>"""
FASTEST = np.array([0.5, 1.0])


def make_profile(*, limited: bool = True) -> RobotProfile:
    one = np.ones(2)
    limits = JointLimits(lower=-one, upper=one, velocity=FASTEST, acceleration=one, effort=one)
    return RobotProfile(
        name="pair",
        base_link="base",
        arm_joints=ARM,
        limits=limits if limited else None,
        home_rad=np.zeros(2),
        cameras=(),
        urdf=URDF,
    )


def sample(
    *position: float, names: tuple[str, ...] = ARM, at_s: float = 0.0, offset_s: float = 0.0
) -> JointSample:
    """A sample received `at_s` after the first one, with a stamp `offset_s` later."""
    return JointSample(
        names=names,
        position=np.array(position),
        stamp_ns=START_NS + round((at_s + offset_s) * S_NS),
    )


def accept(
    watch: JointWatch,
    *position: float,
    at_s: float = 0.0,
    offset_s: float = 0.0,
    names: tuple[str, ...] = ARM,
) -> bool:
    state = sample(*position, names=names, at_s=at_s, offset_s=offset_s)
    return watch.accept(state, START_S + at_s, START_NS + round(at_s * S_NS))


@pytest.fixture
def watch() -> JointWatch:
    """A watch that has seen the arm at 0."""
    watch = JointWatch(make_profile(), TIMEOUT_S)
    assert accept(watch, 0.0, 0.0)
    return watch


def test_a_watch_that_has_seen_nothing_knows_no_joints() -> None:
    watch = JointWatch(make_profile(), TIMEOUT_S)
    assert watch.joints is None
    assert watch.age_s(3.0) == math.inf


def test_a_state_is_as_old_as_its_arrival(watch: JointWatch) -> None:
    assert accept(watch, 0.01, 0.0, at_s=0.1, offset_s=-0.05)
    assert watch.age_s(START_S + 0.3) == pytest.approx(0.2)


def test_an_accepted_state_is_kept_whole(watch: JointWatch) -> None:
    assert accept(watch, 0.3, 0.01, 0.0, at_s=0.1, names=("finger", "turn", "lift"))
    assert watch.joints is not None
    assert watch.joints.names == ("finger", "turn", "lift")
    assert watch.joints.position.tolist() == [0.3, 0.01, 0.0]


@pytest.mark.parametrize("late_s", [0.0, 0.1, TIMEOUT_S, -TIMEOUT_S])
def test_a_stamp_may_be_off_by_the_timeout(late_s: float) -> None:
    watch = JointWatch(make_profile(), TIMEOUT_S)
    assert accept(watch, 0.0, 0.0, offset_s=-late_s)


def test_a_state_that_was_measured_too_long_ago_is_late(watch: JointWatch) -> None:
    with pytest.raises(NotReadyError, match=r"measured 0\.251 s ago, at most 0\.25 s"):
        accept(watch, 0.0, 0.0, at_s=0.5, offset_s=-0.251)
    assert watch.joints is not None
    assert watch.joints.stamp_ns == START_NS


def test_a_state_that_is_a_nanosecond_too_old_is_late() -> None:
    watch = JointWatch(make_profile(), 2.0)
    with pytest.raises(NotReadyError):
        watch.accept(sample(0.0, 0.0), START_S, START_NS + 2 * S_NS + 1)


def test_a_state_of_the_future_is_invalid(watch: JointWatch) -> None:
    with pytest.raises(InvalidInputError, match=r"measured 0\.251 s in the future"):
        accept(watch, 0.0, 0.0, at_s=0.5, offset_s=0.251)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_position_may_be_other_than_a_number(watch: JointWatch, bad: float) -> None:
    with pytest.raises(UnsafeError, match="non-finite"):
        accept(watch, 0.0, 0.0, bad, at_s=0.1, names=(*ARM, "finger"))


def test_every_joint_of_the_arm_must_be_measured(watch: JointWatch) -> None:
    with pytest.raises(UnsafeError, match="lack"):
        accept(watch, 0.0, at_s=0.1, names=("turn",))


def test_a_repeated_state_is_passed_over_and_does_not_count_as_fresh(watch: JointWatch) -> None:
    assert not accept(watch, 0.0, 0.0, at_s=0.1, offset_s=-0.1)
    assert watch.age_s(START_S + 0.1) == pytest.approx(0.1)


def test_a_state_older_than_the_one_before_is_refused(watch: JointWatch) -> None:
    with pytest.raises(InvalidInputError, match="older than the one before"):
        accept(watch, 0.0, 0.0, at_s=0.1, offset_s=-0.1 - 1e-9)


@pytest.mark.parametrize("at_s", [0.02, 0.1])
@pytest.mark.parametrize(("joint", "slack"), [(0, 0.01), (1, 0.05)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_may_go_at_twice_its_velocity_limit_and_a_slack(
    watch: JointWatch, joint: int, slack: float, sign: float, at_s: float
) -> None:
    farthest = 2.0 * FASTEST[joint] * at_s + slack
    there = np.zeros(2)
    there[joint] = sign * (farthest + 1e-6)
    with pytest.raises(UnsafeError, match=f"{ARM[joint]} is measured at"):
        accept(watch, *there, at_s=at_s)
    there[joint] = sign * (farthest - 1e-6)
    assert accept(watch, *there, at_s=at_s)


def test_the_bound_itself_is_allowed(watch: JointWatch) -> None:
    """0.0625 s and 0.5 are exact in binary."""
    watch = JointWatch(make_profile(), TIMEOUT_S)
    watch._slack = np.array([0.0, 0.0])
    accept(watch, 0.0, 0.0)
    assert accept(watch, 0.0625, 0.125, at_s=0.0625)


def test_a_jump_is_measured_from_the_last_state_that_was_believed(watch: JointWatch) -> None:
    assert accept(watch, 0.0, 0.1, at_s=0.1)
    with pytest.raises(
        UnsafeError, match=r"turn is measured at 0\.5000, 0\.4000 from where it was 0\.050 s before"
    ):
        accept(watch, 0.0, 0.5, at_s=0.15)
    assert watch.joints is not None
    assert watch.joints.position[1] == 0.1
    assert watch.age_s(START_S + 0.15) == pytest.approx(0.05)
    assert accept(watch, 0.0, 0.15, at_s=0.2)


def test_the_joint_that_is_farthest_beyond_its_bound_is_named(watch: JointWatch) -> None:
    with pytest.raises(UnsafeError, match=r"lift is measured at 0\.9000"):
        accept(watch, 0.9, 0.9, at_s=0.1)


def test_after_a_timeout_an_arm_that_was_moved_is_believed(watch: JointWatch) -> None:
    with pytest.raises(UnsafeError, match="no arm is that fast"):
        accept(watch, 0.9, 0.9, at_s=TIMEOUT_S)
    assert accept(watch, 0.9, 0.9, at_s=TIMEOUT_S + 1e-6)


def test_after_a_timeout_a_clock_that_was_set_back_is_believed(watch: JointWatch) -> None:
    watch.joints = sample(0.0, 0.0, offset_s=3600.0)
    assert accept(watch, 0.0, 0.0, at_s=TIMEOUT_S + 1e-6)


def test_an_arm_without_known_limits_may_be_anywhere() -> None:
    watch = JointWatch(make_profile(limited=False), TIMEOUT_S)
    assert accept(watch, 0.0, 0.0)
    assert accept(watch, 0.9, 0.9, at_s=0.01)


@pytest.mark.parametrize(
    ("kind", "before", "now", "is_believed"),
    [
        ("continuous", math.pi - 0.01, -math.pi + 0.01, True),
        ("revolute", math.pi - 0.01, -math.pi + 0.01, False),
        ("continuous", 0.3, 0.3 + 4 * math.pi, True),
        ("revolute", 0.3, 0.3 + 4 * math.pi, False),
        ("continuous", 7.0, 7.01, True),
        ("continuous", 0.0, math.pi, False),
        ("continuous", math.pi - 0.2, -math.pi + 0.2, False),
    ],
)
def test_a_whole_turn_of_a_continuous_joint_is_no_jump(
    kind: str, before: float, now: float, is_believed: bool
) -> None:
    urdf = URDF.replace('name="turn" type="revolute"', f'name="turn" type="{kind}"')
    watch = JointWatch(replace(make_profile(), urdf=urdf), TIMEOUT_S)
    assert accept(watch, 0.0, before)
    if is_believed:
        assert accept(watch, 0.0, now, at_s=0.02)
        return
    with pytest.raises(UnsafeError, match="turn is measured at"):
        accept(watch, 0.0, now, at_s=0.02)
