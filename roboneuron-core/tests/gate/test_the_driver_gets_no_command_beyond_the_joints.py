"""The limits in front of a driver, by a table of commands; arms and grippers, both directions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planar import NAMES, START, profile

from roboneuron.contract import JointCommand, JointSample, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import DriverLimiter, MotionRules
from roboneuron.gate.motion.joint_space import JointLimit

NOW_S = 100.0
FINGER = "finger"


def limiter(
    place: Sequence[float] = tuple(START), *, braking: bool = False, **fractions: float
) -> DriverLimiter:
    """At rest at `place`; velocities up to 1.0 and 1.5 rad/s, accelerations up to 4 rad/s^2."""
    made = DriverLimiter(profile(braking=braking), MotionRules(reactions={}, **fractions))
    measure(made, place)
    return made


def measure(made: DriverLimiter, place: Sequence[float]) -> None:
    made.measure(JointSample(names=(*NAMES, FINGER), position=np.array([*place, 0.02])))


def command(
    *position: float, duration_s: float = 0.1, names: tuple[str, ...] = NAMES
) -> JointCommand:
    return JointCommand(names=names, position=np.array(position), duration_s=duration_s)


def rule_of(made: DriverLimiter, asked: JointCommand) -> str:
    with pytest.raises(RefusedError) as refusal:
        made.admit([asked], NOW_S)
    with pytest.raises(RefusedError):
        made.limit(asked, NOW_S)
    return refusal.value.rule


@pytest.mark.parametrize(
    ("asked", "rule"),
    [
        (command(math.nan, 1.2), "not_finite"),
        (command(math.inf, 1.2), "not_finite"),
        (command(0.3, -math.inf), "not_finite"),
        (command(1e300, 1.2), "limit_position"),
        (command(2.01, 1.2, duration_s=9.0), "limit_position"),
        (command(-2.01, 1.2, duration_s=9.0), "limit_position"),
        (command(0.3, 0.05, duration_s=9.0), "limit_position"),
        (command(0.3 + 1.0 * 0.1 + 0.11, 1.2), "joint_jump"),
        (command(0.3 - 1.0 * 0.1 - 0.11, 1.2), "joint_jump"),
        (command(0.3, 1.2 + 1.5 * 0.1 + 0.11), "joint_jump"),
        (command(0.3, 1.2, duration_s=0.0), "malformed_command"),
        (command(0.3, 1.2, duration_s=-1.0), "malformed_command"),
        (command(0.3, 1.2, duration_s=math.nan), "malformed_command"),
        (command(0.3, 1.2, duration_s=math.inf), "malformed_command"),
        (command(0.3), "malformed_command"),
        (command(0.3, 1.2, 0.0), "malformed_command"),
        (command(names=()), "malformed_command"),
        (command(0.3, 0.3, names=("a", "a")), "malformed_command"),
        (command(0.3, 1.2, names=("a", "elbow")), "unknown_joint"),
        (command(0.3, 1.2, 0.05, names=(*NAMES, FINGER)), "limit_position"),
        (command(0.3, 1.2, -0.01, names=(*NAMES, FINGER)), "limit_position"),
        (command(0.05, names=(FINGER,)), "limit_position"),
    ],
    ids=str,
)
def test_what_cannot_be_meant_is_refused_with_its_reason(asked: JointCommand, rule: str) -> None:
    assert rule_of(limiter(), asked) == rule


@pytest.mark.parametrize(
    "asked",
    [
        command(0.3, 1.2),
        command(0.31, 1.19),
        command(1.19, 0.31, names=("b", "a")),
        command(0.31, names=("a",)),
        command(0.0, names=(FINGER,)),
        command(0.31, 1.2, 0.04, names=(*NAMES, FINGER), duration_s=0.2),
        command(2.0, 0.1, duration_s=5.0),
    ],
    ids=str,
)
def test_what_the_joints_can_do_is_passed_as_it_is(asked: JointCommand) -> None:
    made = limiter()
    assert made.admit([asked], NOW_S) == [asked]
    passed = made.limit(asked, NOW_S)
    assert passed.command is asked
    assert passed.acted == ()


@pytest.mark.parametrize(
    ("asked", "acted", "duration_s"),
    [
        (command(0.3 + 0.15, 1.2), ("velocity", "acceleration"), math.sqrt(0.15 / 4.0)),
        (command(0.3 - 0.6, 1.2, duration_s=0.55), ("velocity",), 0.6),
        (command(0.3 + 0.04, 1.2, duration_s=0.05), ("acceleration",), 0.1),
    ],
)
def test_what_is_a_little_too_fast_gets_the_time_it_needs(
    asked: JointCommand, acted: tuple[str, ...], duration_s: float
) -> None:
    passed = limiter().limit(asked, NOW_S)
    assert passed.acted == acted
    assert passed.command.duration_s == pytest.approx(duration_s, rel=1e-5)
    np.testing.assert_array_equal(passed.command.position, asked.position)


def test_fractions_are_of_both_limits_and_can_be_changed() -> None:
    made = limiter(velocity_fraction=0.5, acceleration_fraction=0.25)
    assert rule_of(made, command(0.3 + 0.16, 1.2)) == "joint_jump"
    slow = made.limit(command(0.3 + 0.04, 1.2, duration_s=0.1), NOW_S)
    assert slow.command.duration_s == pytest.approx(math.sqrt(0.04 / 1.0), rel=1e-5)
    made.use(MotionRules(reactions={}))
    assert made.limit(command(0.3 + 0.04, 1.2, duration_s=0.1), NOW_S).acted == ()


def test_a_joint_may_not_be_fast_close_to_its_limit() -> None:
    made = limiter((1.9, 1.2), braking=True)
    passed = made.limit(command(1.99, 1.2, duration_s=0.3), NOW_S)
    fastest = -0.1 + math.sqrt(2 * 2.0 * 0.01)
    assert passed.acted == ("velocity",)
    assert passed.command.duration_s == pytest.approx(0.09 / fastest, rel=1e-5)
    assert made.limit(command(1.81, 1.2, duration_s=0.3), NOW_S).acted == ()


def test_without_a_measurement_nothing_is_passed() -> None:
    made = DriverLimiter(profile(), MotionRules(reactions={}))
    assert rule_of(made, command(0.3, 1.2)) == "not_measured"
    measure(made, START.tolist())
    assert made.limit(command(0.3, 1.2), NOW_S).acted == ()
    made.measure(None)
    assert rule_of(made, command(0.3, 1.2)) == "not_measured"


def test_a_command_starts_where_the_last_one_has_brought_the_joints() -> None:
    """Commands that come twice as often move the arm no faster."""
    made = limiter()
    made.note_sent(command(0.4, 1.2), NOW_S)
    passed = made.limit(command(0.5, 1.2), NOW_S + 0.05)
    assert passed.acted == ("velocity",)
    assert passed.command.duration_s == pytest.approx(0.15, rel=1e-5)


def test_a_joint_that_does_not_follow_starts_where_it_is_measured() -> None:
    made = limiter()
    made.note_sent(command(0.6, 1.2, duration_s=0.3), NOW_S)
    later = NOW_S + 0.3
    with pytest.raises(RefusedError):
        made.limit(command(0.75, 1.2, duration_s=0.1), later)
    measure(made, (0.55, 1.2))
    assert made.limit(command(0.65, 1.2, duration_s=0.1), later).acted == ()


def test_braking_passes_whatever_the_acceleration() -> None:
    """A hold commands the measured posture, behind where the commands have brought the arm."""
    made = limiter((0.5, 1.2))
    made.note_sent(command(0.6, 1.2), NOW_S)
    measure(made, (0.52, 1.2))
    passed = made.limit(command(0.53, 1.2, duration_s=0.05), NOW_S + 0.03)
    assert passed.acted == ()


def test_a_reversal_takes_its_time() -> None:
    made = limiter((0.5, 1.2))
    made.note_sent(command(0.6, 1.2), NOW_S)
    passed = made.limit(command(0.43, 1.2), NOW_S + 0.01)
    assert passed.acted == ("acceleration",)


def test_after_a_hold_the_arm_starts_where_it_is_measured() -> None:
    made = limiter()
    made.note_sent(command(0.4, 1.2), NOW_S)
    made.note_hold()
    assert made.ends_s == 0.0
    assert made.limit(command(0.31, 1.2), NOW_S + 0.1).acted == ()


@pytest.mark.parametrize(("place", "out"), [(2.05, 1.0), (-2.05, -1.0)])
def test_an_arm_outside_its_limits_may_stay_or_return(place: float, out: float) -> None:
    made = limiter((place, 1.2))
    assert made.limit(command(place, 1.2), NOW_S).command.position[0] == place
    assert made.limit(command(place - 0.03 * out, 1.2), NOW_S).acted == ()
    passed = made.limit(command(place + 0.0005 * out, 1.2), NOW_S)
    assert passed.acted == ("position",)
    assert passed.command.position[0] == place
    assert rule_of(made, command(place + 0.01 * out, 1.2)) == "limit_position"


def test_the_noise_of_a_measurement_at_a_limit_is_no_fault() -> None:
    made = limiter((1.9999, 1.2))
    passed = made.limit(command(2.0004, 1.2), NOW_S)
    assert passed.acted == ("position",)
    assert passed.command.position[0] == 2.0


def test_every_point_of_a_trajectory_is_checked_before_the_first_is_sent() -> None:
    made = limiter()
    good = [command(0.3 + 0.02 * k, 1.2) for k in (1, 2, 3)]
    assert made.admit(good, NOW_S) == good
    with pytest.raises(RefusedError, match=r"^points\[3\]: a ") as refusal:
        made.admit([*good, command(0.9, 1.2)], NOW_S)
    assert refusal.value.rule == "joint_jump"
    later = made.admit([*good, command(0.5, 1.2)], NOW_S)[3]
    assert later.duration_s > 0.1, "planned points are within the limits too"


def test_a_base_without_joints_has_no_limits_but_those_of_form() -> None:
    made = DriverLimiter(RobotProfile(name="base"), MotionRules(reactions={}))
    assert made.limit(command(7.0, names=("lift",)), NOW_S).acted == ()
    assert rule_of(made, command(math.nan, names=("lift",))) == "not_finite"


steps = st.lists(
    st.tuples(
        st.tuples(*[st.floats(-4.0, 4.0) for _ in NAMES]),
        st.floats(0.0, 0.5),
        st.one_of(st.floats(0.001, 0.4), st.floats(0.4, 5.0)),
        st.booleans(),
    ),
    min_size=1,
    max_size=25,
)


@settings(max_examples=60, deadline=None)
@given(steps=steps, braking=st.booleans(), lag=st.floats(0.0, 0.09))
def test_no_sequence_of_commands_leaves_the_limits(
    steps: list[tuple[tuple[float, float], float, float, bool]], braking: bool, lag: float
) -> None:
    """Judged by the motion itself: straight lines, replaced at any time."""
    made = limiter(braking=braking)
    limits = JointLimit.by_joint(profile(braking=braking))
    place, goal, velocity, left_s = START.copy(), START.copy(), np.zeros(2), 0.0
    now_s = NOW_S
    for asked, wait_s, duration_s, near in steps:
        measure(made, (place - lag * np.sign(velocity)).tolist())
        target = place + np.multiply(asked, 0.03) if near else np.array(asked)
        try:
            passed = made.limit(command(*target, duration_s=duration_s), now_s).command
        except RefusedError:
            pass
        else:
            goal, left_s = passed.position, passed.duration_s
            made.note_sent(passed, now_s)
            velocity = (goal - place) / left_s
        for i, name in enumerate(NAMES):
            limit = limits[name]
            assert limit.lower - 1e-9 <= goal[i] <= limit.upper + 1e-9
            assert abs(velocity[i]) <= limit.velocity * (1.0 + 1e-5)
        place = goal.copy() if wait_s >= left_s else place + velocity * wait_s
        if wait_s >= left_s:
            velocity = np.zeros(2)
        left_s = max(0.0, left_s - wait_s)
        now_s += wait_s


def test_a_continuous_joint_goes_the_shorter_way_in_the_turns_that_it_counts() -> None:
    urdf = '<robot name="r"><joint name="a" type="continuous"/></robot>'
    free = replace(profile(), urdf=urdf)
    assert free.limits is not None
    bounds = replace(free.limits, lower=np.array([-math.inf, 0.1]), upper=np.array([math.inf, 2.5]))
    made = DriverLimiter(replace(free, limits=bounds), MotionRules(reactions={}))
    measure(made, (3.1, 1.2))
    passed = made.limit(command(-3.1, 1.2, duration_s=0.2), NOW_S)
    assert passed.acted == ()
    assert passed.command.position[0] == pytest.approx(2 * math.pi - 3.1)
    made.note_sent(passed.command, NOW_S)
    measure(made, (-3.1, 1.2))
    # moving at 0.42 rad/s: from rest this would take its time
    passed = made.limit(command(-3.06, 1.2, duration_s=0.045), NOW_S + 0.2)
    assert passed.acted == ()
    assert passed.command.position[0] == pytest.approx(-3.06)
