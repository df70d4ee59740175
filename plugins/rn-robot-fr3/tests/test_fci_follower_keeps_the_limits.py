"""The arm's commanded state stays within its limits, whichever packets are lost; in virtual
time.
"""

from __future__ import annotations

import random
from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("ruckig", reason="needs ruckig: pip install './plugins/rn-robot-fr3[fci]'")

from fci_box.judge import CommandJudge

from rn_robot_fr3.fci.follower import LONGEST_GAP, LONGEST_UNHEARD, Course, Follower
from rn_robot_fr3.fci.planner import (
    ACCELERATION_LIMIT_RAD_S2,
    JERK_LIMIT_RAD_S3,
    STOP_ACCELERATION_RAD_S2,
    VELOCITY_LIMIT_RAD_S,
    plan,
)
from rn_robot_fr3.limits import LOWER_RAD, UPPER_RAD
from rn_robot_fr3.profile import HOME_RAD

HOME = list(HOME_RAD)
STOP = tuple(STOP_ACCELERATION_RAD_S2.tolist()), tuple(JERK_LIMIT_RAD_S3.tolist())


def course(position: list[float], target: np.ndarray, factor: float) -> Course:
    """The course as created by `FciArm.go`."""
    way = plan(np.array(position), target, 0.05, factor)
    return Course(
        target=tuple(way.target.tolist()),
        velocity=tuple((way.velocity_factor * VELOCITY_LIMIT_RAD_S).tolist()),
        acceleration=tuple((factor * ACCELERATION_LIMIT_RAD_S2).tolist()),
        jerk=tuple((factor * JERK_LIMIT_RAD_S3).tolist()),
    )


def rounded(values: list[float]) -> list[float]:
    """Values rounded as in a state."""
    return np.array(values, dtype=np.float32).astype(float).tolist()


class Arm:
    """An arm that loses states and commands, and its judge."""

    def __init__(self, position: list[float]) -> None:
        self.follower = Follower(position, *STOP)
        self.judge = CommandJudge()
        self.judge.begin(list(position))
        self._newer_by = 1

    @property
    def position(self) -> list[float]:
        assert self.judge.arm is not None
        return self.judge.arm.position

    def cycle(self, *, state_is_lost: bool = False, command_is_lost: bool = False) -> None:
        """One millisecond."""
        arm = self.judge.arm
        assert arm is not None
        if state_is_lost:
            self._newer_by += 1
            self.judge.miss()
            return
        state = rounded(arm.position), rounded(arm.velocity), rounded(arm.acceleration)
        command = self.follower.next(*state, self._newer_by)
        self._newer_by = 1
        if command_is_lost:
            self.judge.miss()
        else:
            self.judge.take(command)

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.cycle()

    def within_limits(self) -> bool:
        assert self.judge.beyond == []
        return self.judge.counts["violations"] == 0


def anywhere(dice: random.Random) -> np.ndarray:
    return np.array(
        [dice.uniform(low, high) for low, high in zip(LOWER_RAD, UPPER_RAD, strict=True)]
    )


def near_home(dice: random.Random) -> np.ndarray:
    return np.array([q + dice.uniform(-0.3, 0.3) for q in HOME])


@pytest.mark.parametrize("where", [near_home, anywhere])
@pytest.mark.parametrize("loss", [0.0, 0.01, 0.05, 0.2])
@pytest.mark.parametrize("factor", [0.3, 0.5])
def test_no_command_is_beyond_a_limit_whatever_is_lost(
    where: Callable[[random.Random], np.ndarray], loss: float, factor: float
) -> None:
    dice, arm, silence = random.Random(7), Arm(HOME), 0
    for number in range(4_000):
        if number % 400 == 0 or (where is near_home and number % 50 == 0):
            arm.follower.aim(course(arm.position, where(dice), factor))
        if dice.random() < 0.001:
            arm.follower.brake()
        if loss and silence == 0 and dice.random() < 0.004:
            silence = dice.randint(1, LONGEST_GAP - 1)
        silence = max(0, silence - 1)
        arm.cycle(
            state_is_lost=silence > 0 or dice.random() < loss, command_is_lost=dice.random() < loss
        )
    assert arm.within_limits()
    assert arm.judge.worst["acceleration"] > 0.2, "it did move"


@pytest.mark.parametrize("silence", [1, 2, 3, 5, 9, LONGEST_GAP - 1])
def test_after_a_silence_at_any_time_of_a_motion_the_arm_arrives_without_a_jump(
    silence: int,
) -> None:
    target = np.array(HOME) + np.array([0.4, 0.1, -0.3, 0.2, 0.5, 0.3, -0.4])
    for begins in range(5, 700, 99):
        arm = Arm(HOME)
        arm.follower.aim(course(HOME, target, 0.5))
        arm.cycles(begins)
        for _ in range(silence):
            arm.cycle(state_is_lost=True)
        arm.cycles(1500)
        assert arm.within_limits(), f"silence after {begins} ms"
        assert arm.position == pytest.approx(target.tolist(), abs=1e-6)


def test_a_new_target_replaces_a_motion_without_a_jump() -> None:
    dice, arm = random.Random(1), Arm(HOME)
    for _ in range(400):
        arm.follower.aim(course(arm.position, near_home(dice), 0.5))
        arm.cycles(dice.randint(1, 60))
    assert arm.within_limits()
    assert arm.judge.worst["jerk"] < 0.37, "no more than planned: 1800 of 5000 rad/s3"


def test_a_stop_brakes_as_hard_as_it_may_and_does_not_come_back() -> None:
    arm = Arm(HOME)
    arm.follower.aim(course(HOME, np.array(HOME) + 1.0, 0.5))
    arm.cycles(400)
    assert arm.judge.arm is not None
    speed = arm.judge.arm.velocity[0]
    begins = arm.position[0]
    arm.follower.brake()
    places = []
    while not arm.follower.is_resting:
        arm.cycle()
        places.append(arm.position[0])
    assert arm.within_limits()
    assert speed > 0.9
    assert places == sorted(places), "it never goes back"
    assert places[-1] - begins < speed**2 / 2 / 9.0 + speed * 0.008, (
        "braking with 9 rad/s2, and the ramps of the jerk"
    )


def test_an_arm_that_takes_no_command_is_noticed() -> None:
    arm = Arm(HOME)
    arm.follower.aim(course(HOME, np.array(HOME) + 0.3, 0.5))
    arm.cycles(100)
    assert arm.follower.unheard == 0
    # the arm extrapolates with constant acceleration, so there is no difference yet
    for _ in range(LONGEST_UNHEARD + 400):
        arm.cycle(command_is_lost=True)
    assert arm.follower.unheard > LONGEST_UNHEARD


def test_a_course_that_came_to_its_end_rests_there() -> None:
    arm = Arm(HOME)
    target = np.array(HOME) + 0.05
    arm.follower.aim(course(HOME, target, 0.3))
    arm.cycles(3000)
    assert arm.follower.is_resting
    assert arm.position == pytest.approx(target.tolist(), abs=1e-7)
    assert arm.judge.arm is not None
    assert max(map(abs, arm.judge.arm.velocity)) < 1e-9
