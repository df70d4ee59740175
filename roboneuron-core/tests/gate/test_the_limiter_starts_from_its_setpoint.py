"""Start of a command: the setpoint, the measured arm if the setpoint is lost, or behind it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gantry import (
    HOLD,
    SCALE,
    STEP_S,
    at,
    hold,
    limiter,
    place,
    profile,
    sent,
    speed_m_s,
    to,
)

from roboneuron.contract import (
    JointSample,
)
from roboneuron.gate.motion import LimitedCommand


def test_a_command_takes_over_from_where_the_last_one_has_come() -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    assert speed_m_s(judge, 0.06, at(), 10.04) == pytest.approx(0.4), "from 0.02 m"


@pytest.mark.parametrize(
    ("now_s", "speed"), [(10.5, 0.1), (10.999, 0.1), (11.0, 0.2), (12.0, 0.2), (math.inf, 0.2)]
)
def test_a_setpoint_is_good_for_a_second(now_s: float, speed: float) -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    assert speed_m_s(judge, 0.06, at(0.04), now_s) == pytest.approx(speed)


def test_before_the_first_command_the_setpoint_is_what_is_measured() -> None:
    assert speed_m_s(limiter(), 0.06, at(0.04), 10.0) == pytest.approx(0.2)


SLIDES = """<robot name="gantry">
  <joint name="x" type="prismatic"/><joint name="z" type="revolute"/><joint name="turn" type="revolute"/>
</robot>"""  # noqa: E501


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("joint", "away", "is_lost"),
    [
        (0, 0.02, False),
        (0, 0.0201, True),
        (1, 0.1, False),
        (1, 0.1001, True),
        (2, 0.1, False),
        (2, 0.1001, True),
    ],
)
def test_a_setpoint_is_lost_when_a_joint_is_2_cm_or_a_tenth_of_a_radian_away(
    sign: float, joint: int, away: float, is_lost: bool
) -> None:
    judge, measured = limiter(robot=profile(urdf=SLIDES)), np.zeros(3)
    judge.limit(to(), at(), 10.0)
    measured[joint] = sign * away
    verdict = judge.limit(to(0.05), at(*measured), 10.1)
    assert verdict.reference_lost is is_lost
    assert place(verdict) == [0.05, 0.0, 0.0]
    assert verdict.asked is not None
    start = measured if is_lost else np.zeros(3)
    assert verdict.asked.speed_m_s == pytest.approx(math.hypot(0.05 - start[0], start[1]) / STEP_S)


def test_where_the_setpoint_is_lost_the_arm_starts_from_rest() -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.limit(to(0.1), at(), 10.0)
    moving = judge.limit(to(0.21), at(0.05), 10.05)
    assert moving.acted == ("acceleration",), "from 1 m/s to 1.5 m/s at most, by 10 m/s^2 in 0.05 s"
    judge.follow(to(0.1), at(), 10.0)
    lost = judge.limit(to(1.1), at(1.0), 10.05)
    assert lost.reference_lost
    assert place(lost) == pytest.approx([1.05, 0.0, 0.0]), "0.5 m/s from rest"


@pytest.mark.parametrize(
    ("now_s", "end_m"),
    [
        # From 1 m/s, kept to its end at 10.1 s, then braking with 10 m/s^2.
        (10.1, 0.1),
        (10.101, 0.099),
        (10.15, 0.05),
        (10.2, 0.0),
        (10.5, 0.0),
    ],
)
def test_an_arm_reverses_no_faster_after_the_end_of_a_command(now_s: float, end_m: float) -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.limit(to(0.1), at(), 10.0)
    verdict = judge.limit(to(), at(0.1), now_s)
    assert place(verdict) == pytest.approx([end_m, 0.0, 0.0])
    assert (verdict.acted == ()) is (end_m == 0.0)


@pytest.mark.parametrize("late_s", [0.0, 1e-9, 0.004])
def test_a_steady_motion_goes_on_although_its_command_has_just_ended(late_s: float) -> None:
    judge = limiter(robot=profile(acceleration=5.0))
    judge.follow(to(0.1), at(), 10.0)
    verdict = judge.limit(to(0.2), at(0.1), 10.1 + late_s)
    assert verdict.acted == ()
    assert place(verdict) == pytest.approx([0.2, 0.0, 0.0])


def test_a_command_that_another_process_sent_is_the_setpoint() -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.follow(to(0.1), at(), 10.0)
    verdict = judge.limit(to(0.3), at(0.05), 10.05)
    # From 0.05 m at 1 m/s; in 0.05 s it gains 0.5 m/s, which it keeps for 0.1 s.
    assert place(verdict) == pytest.approx([0.2, 0.0, 0.0])
    assert verdict.share == pytest.approx(0.6)


def test_after_an_invalid_command_of_another_process_there_is_no_setpoint() -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    judge.follow(to(math.nan), at(), 10.05)
    assert speed_m_s(judge, 0.06, at(0.04), 10.1) == pytest.approx(0.2)


def test_an_arm_at_rest_speeds_up_from_the_time_on_when_it_was_seen_to_rest() -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.limit(to(0.05), at(), 10.0)
    judge.rest(at(0.02), 10.05)
    verdict = judge.limit(to(0.12), at(0.01), 10.06)
    assert verdict.asked is not None
    assert verdict.asked.speed_m_s == pytest.approx(1.0), "from 0.02 m"
    assert place(verdict) == pytest.approx([0.03, 0.0, 0.0]), "0.1 m/s after 0.01 s"


@pytest.mark.parametrize(
    "joints", [None, at(math.nan), JointSample(names=("x",), position=np.zeros(1))]
)
def test_an_arm_of_which_nothing_is_known_has_no_setpoint(joints: JointSample | None) -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.limit(to(0.05), at(), 10.0)
    judge.rest(joints, 10.05)
    verdict = judge.limit(to(0.24), at(0.04), 10.06)
    assert place(verdict) == pytest.approx([0.14, 0.0, 0.0]), "1 m/s after the whole 0.1 s"


def test_a_clock_that_runs_back_gives_no_time_to_change_a_velocity() -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.limit(to(0.1), at(), 10.0)
    verdict = judge.limit(to(0.2), at(), 9.0)
    assert verdict.acted == ("acceleration",)
    assert place(verdict) == pytest.approx([0.1, 0.0, 0.0])
    assert judge.limit(to(0.1), at(), 9.0).acted == ()


def behind(max_speed_m_s: float = 0.1, acceleration: float = 1e3, **options: Any) -> LimitedCommand:
    """The arm was sent 10 mm, stood still, and has to go 10 mm farther: 20 mm in 0.1 s."""
    rules = replace(SCALE, max_speed_m_s=max_speed_m_s)
    judge = limiter(rules, profile(acceleration=acceleration), **options)
    judge.follow(to(0.01), at(), 10.0)
    return judge.limit(to(0.02), at(), 10.0999999)


@pytest.mark.parametrize("acceleration", [1e3, 0.6])
def test_an_arm_behind_its_setpoint_has_the_time_that_it_needs(acceleration: float) -> None:
    verdict = behind(max_speed_m_s=0.11, acceleration=acceleration)
    assert verdict.acted == ()
    assert place(verdict) == [0.02, 0.0, 0.0]
    needed_s = 0.02 / (0.98 * 0.11)
    assert sent(verdict).duration_s == pytest.approx(needed_s)
    assert verdict.asked is not None
    assert verdict.sent is not None
    assert verdict.asked.speed_m_s == pytest.approx(0.1, rel=1e-5)
    assert verdict.sent.speed_m_s == pytest.approx(0.01 / needed_s, rel=1e-5)


@pytest.mark.parametrize("longest_s", [0.15, 0.1])
def test_an_arm_behind_its_setpoint_has_no_more_time_than_a_command_may_last(
    longest_s: float,
) -> None:
    assert sent(behind(max_speed_m_s=0.11, longest_s=longest_s)).duration_s == longest_s


def test_an_arm_that_could_catch_up_within_the_limit_has_no_more_time() -> None:
    assert sent(behind(max_speed_m_s=0.2)).duration_s == STEP_S


def test_an_arm_behind_its_setpoint_that_turns_has_the_time_to_turn() -> None:
    judge = limiter(replace(SCALE, max_speed_m_s=0.11, max_turn_rad_s=0.6))
    judge.follow(to(0.01, 0.0, 0.05), at(), 10.0)
    verdict = judge.limit(to(0.02, 0.0, 0.1), at(), 10.0999999)
    assert sent(verdict).duration_s == pytest.approx(0.02 / (0.98 * 0.11)), "the turn needs 0.17 s"
    slower = limiter(replace(SCALE, max_speed_m_s=0.11, max_turn_rad_s=0.51))
    slower.follow(to(0.001, 0.0, 0.05), at(), 10.0)
    verdict = slower.limit(to(0.002, 0.0, 0.1), at(), 10.0999999)
    assert sent(verdict).duration_s == pytest.approx(0.1 / (0.98 * 0.51))


def test_an_arm_behind_its_setpoint_brakes_no_harder_than_it_may() -> None:
    verdict = behind(max_speed_m_s=0.11, acceleration=0.3)
    assert verdict.acted == ()
    # From 0.1 m/s with 0.3 m/s^2 for 0.1 s to 0.07 m/s, with which 10 mm take 0.143 s; the
    # bisection interval, 0.1 to 0.186 s, has a 64th of 1.4 ms.
    assert 0.01 / 0.07 - 0.0014 < sent(verdict).duration_s <= 0.01 / 0.07 + 1e-6


def test_a_shortened_command_of_an_arm_behind_its_setpoint_has_the_time_that_it_needs() -> None:
    judge = limiter(replace(SCALE, max_speed_m_s=0.2))
    judge.follow(to(0.01), at(), 10.0)
    verdict = judge.limit(to(0.05), at(), 10.1)
    assert verdict.acted == ("speed",)
    assert place(verdict) == pytest.approx([0.0296, 0.0, 0.0]), "98 % of 20 mm farther"
    assert sent(verdict).duration_s == pytest.approx(0.0296 / (0.98 * 0.2))
    assert verdict.sent is not None
    assert verdict.sent.speed_m_s == pytest.approx(0.0196 / sent(verdict).duration_s)
    assert verdict.sent.step_m == pytest.approx(0.0296)


def test_an_immediate_command_is_judged_by_the_time_since_the_last_one() -> None:
    judge = limiter(immediate=True)
    assert sent(judge.limit(to(0.001), at(), 10.0)).duration_s == STEP_S
    for now_s, duration_s in ((10.0625, 0.0625), (10.5, STEP_S), (10.5, 0.001)):
        assert sent(judge.limit(to(0.001), at(0.001), now_s)).duration_s == pytest.approx(
            duration_s, abs=1e-12
        )


def test_an_immediate_command_is_where_it_goes_at_once() -> None:
    judge = limiter(immediate=True)
    judge.limit(to(0.05), at(), 10.0)
    verdict = judge.limit(to(0.06), at(0.05), 10.05)
    assert verdict.asked is not None
    assert verdict.asked.speed_m_s == pytest.approx(0.2), "10 mm in 0.05 s"


def test_an_immediate_command_has_its_velocity_until_the_next_one_is_due() -> None:
    judge = limiter(robot=profile(acceleration=1.0), immediate=True)
    judge.follow(to(0.05, duration_s=0.1), at(), 10.0)
    assert place(judge.limit(to(0.15), at(0.05), 10.1)) == pytest.approx([0.11, 0.0, 0.0]), (
        "0.6 m/s after 0.5 m/s"
    )


@pytest.mark.parametrize(
    ("setpoint", "asked", "reached"),
    [
        # Measured at 0; 0.1 m/s for the robot's 0.1 s are 10 mm, of which 98 % are used.
        (0.005, 0.02, 0.0098),
        (0.0, 0.02, 0.0098),
        (0.009, 0.0101, 0.0098),
        (0.015, 0.03, 0.015),  # it was sent there before
        (-0.005, -0.02, -0.0098),
    ],
)
@pytest.mark.parametrize("joint", [0, 2])
def test_an_immediate_command_ends_where_the_arm_can_be_from_where_it_is(
    joint: int, setpoint: float, asked: float, reached: float
) -> None:
    judge = limiter(replace(SCALE, max_speed_m_s=0.1, max_turn_rad_s=0.1), immediate=True)
    start, target, end = np.zeros(3), np.zeros(3), np.zeros(3)
    start[joint], target[joint], end[joint] = setpoint, asked, reached
    judge.follow(to(*start), at(), 10.0)
    verdict = judge.limit(to(*target, duration_s=0.5), at(), 10.9)
    assert verdict.acted == ("speed",)
    assert place(verdict) == pytest.approx(end.tolist(), abs=1e-9)


def test_an_immediate_command_is_as_short_as_the_farther_of_way_and_turn_needs() -> None:
    judge = limiter(replace(SCALE, max_speed_m_s=0.1, max_turn_rad_s=10.0), immediate=True)
    judge.follow(to(0.001, 0.0, 0.05), at(), 10.0)
    verdict = judge.limit(to(0.02, 0.0, 0.1, duration_s=0.5), at(), 10.9)
    # Twice too fast: 51 % of the 0.1 rad and 20 mm from its position, twice the turn from the
    # setpoint.
    share = max(0.0, 1.0 - 0.51 * 2.0)
    assert place(verdict) == pytest.approx([0.001 + share * 0.019, 0.0, 0.05 + share * 0.05])


def test_an_immediate_command_of_an_arm_behind_may_hold() -> None:
    judge = limiter(replace(HOLD, max_speed_m_s=0.1), immediate=True)
    judge.follow(to(0.005), at(), 10.0)
    verdict = judge.limit(to(0.014, duration_s=0.5), at(), 10.9)
    hold(
        verdict,
        "limit_speed",
        "The arm is behind its setpoint; its TCP would be 1.4 times too fast.",
    )


def test_an_immediate_command_of_an_arm_that_follows_is_not_too_fast() -> None:
    judge = limiter(replace(SCALE, max_speed_m_s=0.1, max_step_m=0.008), immediate=True)
    judge.follow(to(0.005), at(), 10.0)
    assert judge.limit(to(0.0079, duration_s=0.5), at(), 10.9).acted == ()
    judge.follow(to(0.005), at(), 10.0)
    assert judge.limit(to(0.0099, duration_s=0.5), at(), 10.9).acted == ("step",)


TURNING = SLIDES.replace('name="turn" type="revolute"', 'name="turn" type="continuous"')
HALF = math.pi


@pytest.mark.parametrize(
    ("first", "measured", "second", "sent_to"),
    [
        # it was sent beyond half a turn, and counts from there on, or begins anew
        (HALF + 0.02, HALF + 0.01, HALF + 0.04, HALF + 0.04),
        (HALF + 0.02, -HALF + 0.01, -HALF + 0.04, -HALF + 0.04),
        (HALF + 0.02, -HALF + 0.01, HALF + 0.04, -HALF + 0.04),
        (-HALF - 0.02, HALF - 0.01, -HALF - 0.04, HALF - 0.04),
        (7.0, 7.0 - 4 * HALF, 7.02, 7.02 - 4 * HALF),
    ],
)
def test_a_setpoint_of_a_continuous_joint_is_followed_in_whatever_turns_it_is_measured(
    first: float, measured: float, second: float, sent_to: float
) -> None:
    free = np.full(3, np.inf)
    robot = profile(urdf=TURNING)
    assert robot.limits is not None
    robot = replace(robot, limits=replace(robot.limits, lower=-free, upper=free))
    judge = limiter(robot=robot)
    judge.limit(to(0.0, 0.0, first), at(0.0, 0.0, first), 10.0)
    verdict = judge.limit(to(0.0, 0.0, second), at(0.0, 0.0, measured), 10.1)
    assert not verdict.reference_lost
    assert verdict.acted == ()
    assert place(verdict) == pytest.approx([0.0, 0.0, sent_to])
    ends = judge.reference(at(0.0, 0.0, measured), 10.15)
    assert ends.position[2] == pytest.approx(sent_to)


def test_a_revolute_joint_that_is_measured_a_turn_away_is_lost() -> None:
    judge = limiter(robot=profile(urdf=SLIDES))
    judge.limit(to(0.0, 0.0, 2.9), at(0.0, 0.0, 2.9), 10.0)
    assert judge.limit(to(0.0, 0.0, 2.9), at(0.0, 0.0, 2.9 - 2 * HALF), 10.1).reference_lost
