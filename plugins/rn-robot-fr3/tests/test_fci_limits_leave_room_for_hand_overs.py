"""What the client library does when a motion replaces another one, or after a missed cycle, keeps to the arm's limits.

The commands are computed as franky 2.0.0 does (`JointWaypointMotion::initWaypointMotion`,
`PositionWaypointMotion::extrapolateMotion`) and judged as the arm does: backward differences of what it was sent, and
constant acceleration over a cycle without a command. Every sequence of jerks of three cycles before and after is tried.
Against recorded commands of franka-sim 1.1.7 the numbers agree to all digits that it tells (5116.66 rad/s^3 after 9.5
rad/s^2; 14.8 rad/s^2 after two missed cycles, 11.1 after one at a factor of 1.0).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import ACCELERATION_LIMIT_RAD_S2, JERK_LIMIT_RAD_S3
from rn_robot_fr3.limits import ACCELERATION_RAD_S2, JERK_RAD_S3

F64 = NDArray[np.float64]
STEP_S = 0.001
CYCLES = 3
JERKS = np.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=2 * CYCLES))).T
"""Shape (6, n): shares of the greatest jerk, by cycle."""
LARGEST_FACTOR = float(FciDriverOptions.model_json_schema()["properties"]["dynamics_factor"]["maximum"])


class Arm:
    """Differences what it is sent."""

    def __init__(self, acceleration: F64) -> None:
        """After a long time at `acceleration`, at a velocity of 0."""
        self.position = np.zeros_like(acceleration)
        self.velocity = -acceleration * STEP_S / 2.0
        self.acceleration = acceleration.copy()
        self.forget()

    def forget(self) -> None:
        """Judge from here."""
        self.sharpest = self.fastest = np.zeros_like(self.position)

    def take(self, position: F64) -> None:
        """A command."""
        velocity = (position - self.position) / STEP_S
        acceleration = (velocity - self.velocity) / STEP_S
        jerk = (acceleration - self.acceleration) / STEP_S
        self.fastest = np.maximum(self.fastest, np.abs(acceleration))
        self.sharpest = np.maximum(self.sharpest, np.abs(jerk))
        self.position, self.velocity, self.acceleration = position, velocity, acceleration

    def miss(self) -> None:
        """No command in this cycle."""
        self.velocity = self.velocity + self.acceleration * STEP_S
        self.position = self.position + self.velocity * STEP_S


@dataclass
class Motion:
    """State of the client library's trajectory."""

    position: F64
    velocity: F64
    acceleration: F64

    def step(self, jerk: F64) -> F64:
        """The next command."""
        t, a = STEP_S, self.acceleration
        self.position = self.position + self.velocity * t + a * t**2 / 2.0 + jerk * t**3 / 6.0
        self.velocity = self.velocity + a * t + jerk * t**2 / 2.0
        self.acceleration = a + jerk * t
        return self.position

    def replace(self, arm: Arm) -> None:
        """As `initWaypointMotion`."""
        self.velocity, self.acceleration = arm.velocity, arm.acceleration

    def catch_up(self, arm: Arm, cycles: int) -> None:
        """As `extrapolateMotion`: from the velocity that the arm has reached already."""
        gone = arm.acceleration * cycles * STEP_S
        self.position = self.position + (2.0 * arm.velocity + gone) * cycles * STEP_S / 2.0
        self.velocity = self.velocity + gone


def worst(
    acceleration: float, jerk: float, new_jerk: float, *, missed: int = 0, is_replaced: bool = False
) -> tuple[float, float]:
    """Greatest acceleration and jerk that the arm sees from the event on."""
    found = []
    for start in np.linspace(-acceleration, acceleration, 21):
        arm = Arm(np.full(JERKS.shape[1], start))
        motion = Motion(arm.position, np.zeros(JERKS.shape[1]), arm.acceleration)
        is_planned = np.ones(JERKS.shape[1], dtype=bool)
        for share in JERKS[:CYCLES]:
            arm.take(motion.step(jerk * share))
            is_planned &= np.abs(motion.acceleration) <= acceleration + 1e-9
        arm.forget()
        for _ in range(missed):
            arm.miss()
        if is_replaced:
            motion.replace(arm)
        if missed:
            motion.catch_up(arm, missed)
        for share in JERKS[CYCLES:]:
            arm.take(motion.step(new_jerk * share))
            if new_jerk == jerk:  # the limits of a stop are farther
                is_planned &= np.abs(motion.acceleration) <= acceleration + 1e-9
        found.append((arm.fastest[is_planned].max(), arm.sharpest[is_planned].max()))
    fastest, sharpest = np.max(found, axis=0)
    return float(fastest), float(sharpest)


@pytest.mark.parametrize("joint", range(7))
def test_any_motion_and_a_stop_may_replace_any_motion(joint: int) -> None:
    acceleration, jerk = ACCELERATION_LIMIT_RAD_S2[joint], JERK_LIMIT_RAD_S3[joint]
    fastest, sharpest = worst(acceleration, jerk, jerk, is_replaced=True)
    assert fastest <= ACCELERATION_RAD_S2[joint]
    assert sharpest <= JERK_RAD_S3[joint]


@pytest.mark.parametrize("joint", range(7))
def test_a_motion_survives_a_missed_cycle_at_the_largest_factor(joint: int) -> None:
    acceleration, jerk = LARGEST_FACTOR * ACCELERATION_LIMIT_RAD_S2[joint], LARGEST_FACTOR * JERK_LIMIT_RAD_S3[joint]
    fastest, sharpest = worst(acceleration, jerk, jerk, missed=1)
    assert fastest <= ACCELERATION_RAD_S2[joint]
    assert sharpest <= JERK_RAD_S3[joint]


@pytest.mark.parametrize("joint", range(7))
def test_at_the_default_factor_it_may_be_replaced_after_a_missed_cycle_too(joint: int) -> None:
    factor = FciDriverOptions(host="10.0.0.1").dynamics_factor
    acceleration, jerk = factor * ACCELERATION_LIMIT_RAD_S2[joint], factor * JERK_LIMIT_RAD_S3[joint]
    for new_jerk in (jerk, JERK_LIMIT_RAD_S3[joint]):  # by a target, by a stop
        fastest, sharpest = worst(acceleration, jerk, new_jerk, missed=1, is_replaced=True)
        assert fastest <= ACCELERATION_RAD_S2[joint]
        assert sharpest <= JERK_RAD_S3[joint]


def test_the_computation_gives_what_franka_sim_has_seen() -> None:
    assert worst(9.5, 2200.0, 2200.0, is_replaced=True)[1] == pytest.approx(5116.66, abs=0.02)
    assert worst(3.7, 1e-9, 1e-9, missed=2)[0] == pytest.approx(14.8, abs=0.01)
    assert worst(7.4, 1e-9, 1e-9, missed=1)[0] == pytest.approx(11.1, abs=0.01)
