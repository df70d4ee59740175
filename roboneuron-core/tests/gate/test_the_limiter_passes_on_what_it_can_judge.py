"""Commands that the limiter passes on unchanged, and those that it cannot check."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gantry import (
    ARM,
    HOLD,
    SCALE,
    STEP_S,
    Gantry,
    at,
    hold,
    limiter,
    place,
    sent,
    speed_m_s,
    to,
)

from roboneuron.contract import (
    JointCommand,
    JointSample,
    Posture,
    RobotProfile,
)
from roboneuron.errors import UnsafeError


def test_a_command_is_described_as_it_was_asked_and_as_it_is_sent() -> None:
    verdict = limiter(replace(SCALE, max_speed_m_s=0.5)).limit(to(0.3, 0.4, 0.2), at(), 10.0)
    asked, is_sent = verdict.asked, verdict.sent
    assert asked is not None
    assert is_sent is not None
    assert (asked.step_m, asked.step_rad, asked.speed_m_s) == pytest.approx((0.5, 0.2, 5.0))
    assert (asked.turn_rad_s, asked.joint_speed, asked.smallest_singular_value) == (
        pytest.approx(2.0),
        4.0,
        None,
    )
    # 0.5 m/s of 5 m/s, and 98 % of that, because a straight line in joint space is a curve of the
    # TCP.
    assert verdict.share == pytest.approx(0.098)
    assert place(verdict) == pytest.approx([0.0294, 0.0392, 0.0196])
    assert (is_sent.step_m, is_sent.speed_m_s, is_sent.joint_speed) == pytest.approx(
        (0.049, 0.49, 0.392)
    )
    assert verdict.acted == ("speed",)
    assert verdict.reason == "The TCP would move at 5 m/s, allowed is 0.5 m/s."
    assert not verdict.reference_lost


def test_a_command_within_all_limits_is_passed_on_itself() -> None:
    asked = to(0.01)
    verdict = limiter(HOLD).limit(asked, at(), 10.0)
    assert verdict.command is asked
    assert (verdict.acted, verdict.reason, verdict.share) == ((), "", 1.0)
    assert verdict.sent is verdict.asked


def test_a_shortened_command_keeps_its_names_its_gripper_and_its_residuals() -> None:
    asked = JointCommand(
        names=("turn", "finger", "x", "z"),
        position=np.array([0.0, 0.02, 0.1, -0.2]),
        duration_s=STEP_S,
        residual_m=0.25,
        residual_rad=0.5,
    )
    gantry = Gantry()
    command = sent(limiter(replace(SCALE, max_step_m=0.05), gantry=gantry).limit(asked, at(), 10.0))
    share = 0.98 * 0.05 / math.hypot(0.1, 0.2)
    assert command.names == asked.names
    assert command.position.tolist() == pytest.approx([0.0, 0.02, 0.1 * share, -0.2 * share])
    assert (command.duration_s, command.residual_m, command.residual_rad) == (STEP_S, 0.25, 0.5)
    assert asked.position.tolist() == [0.0, 0.02, 0.1, -0.2]


def test_postures_are_asked_for_with_the_joints_beside_the_arm_and_the_stamp() -> None:
    gantry = Gantry()
    judge = limiter(gantry=gantry)
    measured = JointSample(
        names=("finger", *ARM), position=np.array([0.01, 0.0, 0.0, 0.0]), stamp_ns=77
    )
    judge.limit(to(0.05), measured, 10.0)
    with_finger = JointCommand(
        names=("finger", *ARM), position=np.array([0.03, 0.1, 0.0, 0.0]), duration_s=STEP_S
    )
    judge.limit(with_finger, measured, 10.1)
    assert {joints.stamp_ns for joints in gantry.asked} == {77}
    assert {joints.names for joints in gantry.asked} == {(*ARM, "finger")}
    assert [joints.position[[0, 3]].tolist() for joints in gantry.asked] == [
        *([0.0, 0.01], [0.05, 0.01]),
        *([0.0, 0.03], pytest.approx([0.05, 0.03]), [0.1, 0.03]),
    ]
    gantry.asked.clear()
    judge.limit(to(0.1), at(0.1), 10.2)
    assert {joints.names for joints in gantry.asked} == {ARM}


def test_an_arm_without_limits_of_its_own_is_limited_by_the_rules_alone() -> None:
    robot = RobotProfile(name="gantry", arm_joints=ARM)
    assert place(limiter(robot=robot).limit(to(50.0), at(), 10.0)) == [50.0, 0.0, 0.0]
    assert limiter(replace(SCALE, max_step_m=0.05), robot).limit(to(50.0), at(), 10.0).acted == (
        "step",
    )


@pytest.mark.parametrize(
    ("duration_s", "is_held"), [(1.999, False), (2.0, False), (2.001, True), (math.inf, True)]
)
def test_a_command_lasts_no_longer_than_control_may_be_away(
    duration_s: float, is_held: bool
) -> None:
    judge = limiter(longest_s=2.0)
    verdict = judge.limit(to(0.5, duration_s=duration_s), at(), 10.0)
    if not is_held:
        assert sent(verdict).duration_s == duration_s
        return
    hold(verdict, "long_command", "s, at most 2 s are allowed.")
    assert (verdict.acted, verdict.asked, verdict.reference_lost) == ((), None, False)
    assert judge.limit(to(0.5), at(), 10.0).asked is not None


@pytest.mark.parametrize("duration_s", [0.0, -0.1, math.nan, math.inf, -math.inf])
def test_a_command_without_a_time_that_it_takes_holds(duration_s: float) -> None:
    verdict = limiter().limit(to(0.01, duration_s=duration_s), at(), 10.0)
    hold(verdict, "unsafe_command", f"A command lasts {duration_s} s, expected a finite time > 0.")
    assert (verdict.acted, verdict.asked, verdict.reference_lost) == ((), None, False)


@pytest.mark.parametrize(
    ("duration_s", "taken_s"), [(0.5, 0.5), (0.002, 0.002), (0.001, 0.001), (0.0005, 0.001)]
)
def test_a_command_takes_a_millisecond_at_the_least(duration_s: float, taken_s: float) -> None:
    assert sent(limiter().limit(to(0.0, duration_s=duration_s), at(), 10.0)).duration_s == taken_s


def test_a_posture_that_cannot_be_told_holds_and_says_whether_the_setpoint_was_lost() -> None:
    class Broken(Gantry):
        def inspect(self, joints: JointSample) -> Posture:
            if joints.position[1] > 0.0:
                raise UnsafeError("There is no such posture.")
            return super().inspect(joints)

    judge = limiter(gantry=Broken())
    judge.limit(to(0.05), at(), 10.0)
    verdict = judge.limit(to(0.05, 1.0), at(), 10.1)
    hold(verdict, "unsafe_command", "There is no such posture.")
    assert (verdict.acted, verdict.asked, verdict.reference_lost) == ((), None, False)
    assert judge.limit(to(0.05, 1.0), at(0.0, -1.0), 10.1).reference_lost


def test_a_limit_that_holds_after_others_have_shortened_names_them_all_once() -> None:
    rules = replace(HOLD, reactions=HOLD.reactions | {"step": "scale", "speed": "scale"})
    rules = replace(
        rules,
        max_step_m=0.1,
        max_step_rad=0.1,
        max_speed_m_s=1.5,
        upper_m=np.array([0.02, 9.0, 9.0]),
    )
    verdict = limiter(rules).limit(to(0.4, 0.0, 0.4), at(), 10.0)
    hold(verdict, "limit_workspace", "m outside the workspace")
    assert verdict.acted == ("step", "speed", "workspace")
    assert verdict.asked is not None
    assert verdict.asked.step_m == pytest.approx(0.4)
    passed = limiter(replace(rules, upper_m=np.full(3, 9.0))).limit(to(0.4, 0.0, 0.4), at(), 10.0)
    assert passed.acted == ("step", "speed")
    assert passed.share == pytest.approx(0.98 / 4.0)


@pytest.mark.parametrize(("reaction", "is_held"), [("hold", True), ("refuse", False)])
def test_what_is_not_sent_leaves_the_setpoint_as_it_is(reaction: Any, is_held: bool) -> None:
    judge = limiter(replace(SCALE, reactions=SCALE.reactions | {"step": reaction}, max_step_m=0.1))
    judge.limit(to(0.05), at(), 10.0)
    verdict = judge.limit(to(0.5), at(0.04), 10.1)
    assert (verdict.command is None) is not is_held
    assert verdict.reason == "The TCP would move 0.46 m, allowed is 0.1 m."
    assert (verdict.acted, verdict.share, verdict.sent) == (("step",), 0.0, None)
    assert verdict.asked is not None
    assert verdict.asked.speed_m_s == pytest.approx(4.5)
    assert speed_m_s(judge, 0.06, at(0.05), 10.1) == pytest.approx(0.1), (
        "from 0.05 m, where the first one ends"
    )
