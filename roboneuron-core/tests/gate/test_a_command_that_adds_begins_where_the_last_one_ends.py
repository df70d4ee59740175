"""Start joints of a command that adds to the one in progress, such as a velocity."""

from __future__ import annotations

import numpy as np
import pytest
from gantry import at, limiter, to

from roboneuron.contract import JointSample
from roboneuron.gate.motion import MotionLimiter


@pytest.fixture
def judge() -> MotionLimiter:
    """A limiter whose arm has been moving to (0.05, 0.02, 0.01) since 10 s, for 0.1 s."""
    made = limiter()
    made.limit(to(0.05, 0.02, 0.01), at(), 10.0)
    return made


def test_it_begins_at_the_end_of_the_command_in_progress(judge: MotionLimiter) -> None:
    joints = judge.reference(at(0.02), 10.04)
    assert joints.names == at().names
    assert joints.position == pytest.approx([0.05, 0.02, 0.01])


def test_a_later_end_counts_from_where_the_command_began() -> None:
    judge = limiter()
    judge.limit(to(0.05), at(), 10.0)
    judge.limit(to(0.08), at(0.05), 10.1)
    assert judge.reference(at(0.06), 10.15).position == pytest.approx([0.08, 0.0, 0.0])


def test_joints_keep_their_order_and_others_their_measured_place(judge: MotionLimiter) -> None:
    measured = JointSample(
        names=("finger", "turn", "x", "z"), position=np.array([0.03, 0.0, 0.02, 0.0]), stamp_ns=7
    )
    joints = judge.reference(measured, 10.04)
    assert joints.names == measured.names
    assert joints.position == pytest.approx([0.03, 0.01, 0.05, 0.02])
    assert joints.stamp_ns == 7


def test_without_a_command_it_begins_where_the_arm_is() -> None:
    measured = at(0.02)
    assert limiter().reference(measured, 10.0) is measured


@pytest.mark.parametrize(("now_s", "is_kept"), [(10.999, True), (11.0, False), (12.0, False)])
def test_a_command_is_remembered_for_a_second(
    judge: MotionLimiter, now_s: float, is_kept: bool
) -> None:
    measured = at(0.05)
    assert (judge.reference(measured, now_s) is not measured) is is_kept


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("joint", [0, 1, 2])
def test_an_arm_that_does_not_follow_is_not_made_to_catch_up(
    judge: MotionLimiter, joint: int, sign: float
) -> None:
    """The setpoint has only begun to move at 10 s; a tenth of a radian is close enough."""
    away = np.zeros(3)
    away[joint] = sign * 0.1
    assert judge.reference(at(*away), 10.0).position == pytest.approx([0.05, 0.02, 0.01])
    away[joint] = sign * 0.1001
    measured = at(*away)
    assert judge.reference(measured, 10.0) is measured


def test_an_arm_of_which_a_joint_is_not_measured_begins_where_it_is(judge: MotionLimiter) -> None:
    measured = JointSample(names=("x", "z"), position=np.zeros(2))
    assert judge.reference(measured, 10.0) is measured
