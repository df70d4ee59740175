"""The limiter on a gantry whose TCP is where its joints say: each verdict by numbers that are
worked out by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import (
    CollisionProfile,
    GripperProfile,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    Obstacle,
    Pose,
    Posture,
    Proximity,
    RobotProfile,
)
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion import LIMITS, LimitedCommand, MotionLimiter, MotionRules

ARM = ("x", "z", "turn")
SCALE = MotionRules(reactions=dict.fromkeys(LIMITS, "scale"))
HOLD = MotionRules(reactions=dict.fromkeys(LIMITS, "hold"))
STEP_S = 0.1
Near = Callable[[float], float]


def profile(acceleration: float = 1e3, velocity: float = 1e2, **values: Any) -> RobotProfile:
    limits = JointLimits(
        lower=np.full(3, -3.0),
        upper=np.full(3, 3.0),
        velocity=np.full(3, velocity),
        acceleration=np.full(3, acceleration),
        effort=np.ones(3),
    )
    gripper = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
    return RobotProfile(name="gantry", arm_joints=ARM, limits=limits, gripper=gripper, **values)


class Gantry:
    """Two slides along x and z and a turn about z; keeps what it is asked.

    `wall_m` tells the distance of the TCP from a wall by its x; the wall is near below 10 mm.
    """

    def __init__(self, wall_m: Near | None = None) -> None:
        self.asked: list[JointSample] = []
        self.wall_m = wall_m

    def forward(self, joints: JointSample) -> Pose:
        self.asked.append(joints)
        x, z, turn = joints.position[:3].tolist()
        half = turn / 2.0
        return Pose(
            position_m=np.array([x, 0.0, z]),
            quaternion_xyzw=np.array([0, 0, math.sin(half), math.cos(half)]),
        )

    def inspect(self, joints: JointSample) -> Posture:
        pose = self.forward(joints)
        if self.wall_m is None:
            return Posture(pose=pose)
        distance_m = self.wall_m(float(pose.position_m[0]))
        pair = Proximity(first="hand", second="wall", distance_m=distance_m, least_m=0.01)
        return Posture(pose=pose, near=(pair,) if distance_m < 0.01 else ())

    def places(self) -> list[float]:
        """x of each posture that was asked for since the last call."""
        found = [round(float(joints.position[0]), 6) for joints in self.asked]
        self.asked.clear()
        return found


def limiter(
    rules: MotionRules = SCALE,
    robot: RobotProfile | None = None,
    gantry: Gantry | None = None,
    **options: Any,
) -> MotionLimiter:
    arm = gantry or Gantry()
    return MotionLimiter(rules, robot or profile(), arm.forward, arm.inspect, **options)


def at(*position: float) -> JointSample:
    return JointSample(names=ARM, position=np.array([*position, 0.0, 0.0, 0.0][:3]))


def to(*position: float, duration_s: float = STEP_S) -> JointCommand:
    return JointCommand(names=ARM, position=at(*position).position, duration_s=duration_s)


def sent(verdict: LimitedCommand) -> JointCommand:
    assert isinstance(verdict.command, JointCommand), verdict
    return verdict.command


def place(verdict: LimitedCommand) -> list[float]:
    return sent(verdict).position.tolist()


def hold(verdict: LimitedCommand, name: str, reason: str = "") -> None:
    assert isinstance(verdict.command, Hold), verdict
    assert verdict.command.code == name
    assert verdict.command.reason == verdict.reason
    assert reason in verdict.reason
    assert verdict.reason
    assert verdict.sent is None
    assert verdict.share == 0.0


def speed_m_s(judge: MotionLimiter, x: float, measured: JointSample, now_s: float) -> float:
    """With which a command to x within 0.1 s would move the TCP: it tells the setpoint."""
    verdict = judge.limit(to(x), measured, now_s)
    assert verdict.asked is not None
    return verdict.asked.speed_m_s


# What is passed on


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
    # 0.5 m/s of 5 m/s, and of that 98 %: a straight line of the joints is a curve of the TCP.
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


# Commands that cannot be judged


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


# The setpoint


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


def test_a_command_that_another_process_sent_is_the_setpoint() -> None:
    judge = limiter(robot=profile(acceleration=10.0))
    judge.follow(to(0.1), at(), 10.0)
    verdict = judge.limit(to(0.3), at(0.05), 10.05)
    # From 0.05 m at 1 m/s; in 0.05 s it gains 0.5 m/s, which it has for 0.1 s.
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


# Shortening


@pytest.mark.parametrize(
    ("target", "limits", "share"),
    [
        ((0.5, 0.0, 0.0), {"max_step_m": 0.1}, 0.98 / 5.0),
        ((0.5, 0.0, 0.0), {"max_speed_m_s": 2.0}, 0.98 / 2.5),
        ((0.0, 0.0, 0.5), {"max_step_rad": 0.1}, 0.98 / 5.0),
        ((0.0, 0.0, 0.5), {"max_turn_rad_s": 2.0}, 0.98 / 2.5),
        ((0.5, 0.0, 0.5), {"max_step_m": 0.1, "max_turn_rad_s": 2.0}, 0.98 / 5.0),
        ((0.5, 0.0, 0.5), {"max_step_m": 0.25, "max_turn_rad_s": 2.0}, 0.98 / 2.5),
        ((0.5, 0.0, 0.0), {"velocity_fraction": 0.02}, 0.4),
        ((0.5, 0.0, 0.0), {"velocity_fraction": 0.02, "max_step_m": 0.1}, 0.98 / 5.0),
        ((0.5, 0.0, 0.0), {"velocity_fraction": 0.01, "max_step_m": 0.1}, 0.98 / 5.0),
        ((0.5, 0.0, 0.0), {"velocity_fraction": 0.005, "max_step_m": 0.1}, 0.1),
        ((0.5, 0.0, 0.0), {"acceleration_fraction": 0.02}, 0.4),
        ((0.5, 0.0, 0.0), {"acceleration_fraction": 0.02, "max_step_m": 0.1}, 0.98 / 5.0),
        ((0.5, 0.0, 0.0), {"acceleration_fraction": 0.005, "max_step_m": 0.1}, 0.1),
        ((-4.0, 0.0, 0.0), {}, 0.75),
        ((-4.0, 0.0, 0.0), {"velocity_fraction": 0.2}, 0.5),
        ((-12.0, 0.0, 0.0), {"velocity_fraction": 1.0}, 0.25),
    ],
)
def test_a_command_is_shortened_to_the_strictest_limit(
    target: tuple[float, ...], limits: dict[str, float], share: float
) -> None:
    verdict = limiter(replace(SCALE, **limits)).limit(to(*target), at(), 10.0)
    assert verdict.share == pytest.approx(share)
    assert place(verdict) == pytest.approx([share * part for part in target])
    assert sent(verdict).duration_s == STEP_S


def test_an_arm_that_is_to_stop_at_once_goes_on_as_far_as_it_must() -> None:
    judge = limiter(robot=profile(acceleration=8.0))
    judge.follow(to(0.125, duration_s=0.125), at(), 10.0)
    verdict = judge.limit(to(0.0625), at(0.0625), 10.0625)
    assert verdict.acted == ("acceleration",)
    assert verdict.reason == "x would change its velocity faster than its acceleration allows."
    assert place(verdict) == pytest.approx([0.1125, 0.0, 0.0]), "0.5 m/s for 0.1 s"
    assert verdict.share == 1.0, "nothing was asked for, so no share of it"


UP = np.array([0.61, 9.0, 9.0])


@pytest.mark.parametrize(
    ("limits", "name"),
    [
        ({"upper_m": UP}, "workspace"),
        (
            {
                "zones": (
                    Obstacle(
                        name="vase", lower_m=np.array([0.61, -1, -1]), upper_m=np.array([2.0, 1, 1])
                    ),
                )
            },
            "zone",
        ),
    ],
)
def test_a_way_to_a_forbidden_place_is_cut_to_a_64th_of_it(
    limits: dict[str, Any], name: str
) -> None:
    verdict = limiter(replace(SCALE, **limits)).limit(to(1.0, 0.5), at(), 10.0)
    assert verdict.acted == (name,)
    assert verdict.share == pytest.approx(39 / 64), "0.609 m, where 0.61 m are allowed"
    assert place(verdict) == [39 / 64, 39 / 128, 0.0]
    assert verdict.sent is not None
    assert verdict.sent.joint_speed == pytest.approx(390 / 64)


def test_a_way_is_cut_from_where_the_setpoint_is() -> None:
    judge = limiter(replace(SCALE, upper_m=UP))
    judge.limit(to(0.05), at(), 10.0)
    # 56 of 64 parts
    assert place(judge.limit(to(0.69), at(), 10.5)) == pytest.approx([0.05 + 0.56, 0.0, 0.0])


def test_every_forbidden_place_on_the_way_is_named() -> None:
    rules = replace(SCALE, upper_m=UP, min_height_m=-0.5)
    verdict = limiter(rules).limit(to(1.0, -1.0), at(), 10.0)
    assert verdict.acted == ("workspace", "height")
    assert verdict.share == 0.5
    mixed = replace(rules, reactions=rules.reactions | {"height": "refuse"})
    assert limiter(mixed).limit(to(1.0, -1.0), at(), 10.0).command is None


def test_outside_of_the_workspace_no_part_of_a_way_farther_out_is_sent() -> None:
    verdict = limiter(replace(SCALE, upper_m=UP)).limit(to(0.9), at(0.7), 10.0)
    hold(verdict, "limit_workspace", "0.0900 m outside the workspace")
    assert verdict.acted == ("workspace",)


# What would be sent is checked once more


def moving(rules: MotionRules, speed_m_s: float = 1.0, x: float = 0.0) -> MotionLimiter:
    """A limiter of an arm with 4 m/s^2 that is at x at 10.0 s and moves up."""
    judge = limiter(rules, profile(acceleration=4.0))
    judge.follow(to(x + speed_m_s, duration_s=1.0), at(x), 10.0)
    return judge


def test_an_arm_too_fast_for_its_position_limit_holds() -> None:
    judge = moving(SCALE, x=2.45)
    verdict = judge.limit(to(2.95), at(2.95), 10.5)
    # 1 m/s less 4 m/s^2 in 0.1 s: it would go 0.06 m, and 0.05 m are left.
    hold(
        verdict,
        "limit_position",
        "No part of the command is within the limits: x would go to 3.0100",
    )
    assert verdict.acted == ("acceleration", "position")
    assert sent(judge.limit(to(2.95), at(2.94), 10.49)).position[0] == pytest.approx(3.0)


def test_an_arm_too_fast_for_a_zone_holds() -> None:
    verdict = moving(replace(SCALE, upper_m=UP), x=0.1).limit(to(0.7), at(0.6), 10.5)
    hold(
        verdict, "limit_acceleration", "The arm is too fast for a limit before it: The TCP would be"
    )
    assert verdict.acted == ("workspace", "acceleration")


def test_an_arm_too_fast_for_a_new_speed_limit_holds() -> None:
    judge = moving(SCALE)
    judge.use(replace(SCALE, max_speed_m_s=0.5))
    verdict = judge.limit(to(0.6), at(0.5), 10.5)
    hold(verdict, "limit_speed", "The TCP would move at 0.6 m/s, allowed is 0.5 m/s.")
    assert verdict.acted == ("speed", "acceleration")
    judge.use(replace(SCALE, max_speed_m_s=0.7))
    assert sent(judge.limit(to(0.6), at(0.5), 10.5)).position[0] == pytest.approx(0.5686)


def test_new_rules_take_their_shares_of_the_joints_limits() -> None:
    judge = limiter()
    judge.use(replace(SCALE, velocity_fraction=0.01))
    assert judge.limit(to(0.2), at(), 10.0).acted == ("velocity",)
    judge.use(replace(SCALE, acceleration_fraction=0.01))
    judge.rest(None, 10.0)
    assert judge.limit(to(0.2), at(), 10.0).acted == ("acceleration",)


# Behind the setpoint


def behind(max_speed_m_s: float = 0.1, acceleration: float = 1e3, **options: Any) -> LimitedCommand:
    """The arm was sent 10 mm on, stood still, and is to go 10 mm farther: 20 mm in 0.1 s."""
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
    # From 0.1 m/s by 0.3 m/s^2 in 0.1 s to 0.07 m/s, with which 10 mm take 0.143 s; of the time to
    # be found in halves, 0.1 to 0.186 s, a 64th is 1.4 ms.
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


# Commands that carry no time


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
        # Measured at 0; 0.1 m/s in the 0.1 s that a robot takes are 10 mm, and 98 % of them are
        # used.
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
    # Twice too fast: 51 % of the 0.1 rad and 20 mm from where it is, which are twice the turn from
    # the setpoint.
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


# Paths past bodies


def careful(near: Near, **values: Any) -> tuple[MotionLimiter, Gantry]:
    """Postures are looked at every 10 mm."""
    gantry = Gantry(near)
    robot = profile(collision=CollisionProfile(min_distance_m=0.005))
    return limiter(replace(HOLD, **values), robot, gantry), gantry


def free(_: float) -> float:
    return 1.0


def post(x: float) -> float:
    """A post that is near for 11 mm of the way."""
    return abs(x - 0.03) + 0.0045


@pytest.mark.parametrize(("end", "count"), [(0.045, 5), (-0.045, 5), (0.009, 1), (0.0, 1)])
def test_the_way_is_looked_at_from_the_measured_posture_to_the_end(end: float, count: int) -> None:
    judge, gantry = careful(free)
    judge.limit(to(end), at(), 10.0)
    between = [round(end * number / count, 6) for number in range(1, count)]
    assert gantry.places() == [0.0, end, *between]


def test_the_way_of_several_joints_is_looked_at_as_densely_as_their_sum() -> None:
    judge, gantry = careful(free)
    judge.limit(to(0.015, -0.015, 0.015), at(), 10.0)
    assert gantry.places() == [0.0, 0.015, 0.003, 0.006, 0.009, 0.012]


def test_the_way_of_an_arm_behind_its_setpoint_is_looked_at_from_where_it_is() -> None:
    judge, gantry = careful(free)
    judge.follow(to(0.02), at(), 10.0)
    judge.limit(to(0.035), at(0.01), 10.2)
    assert gantry.places() == [0.01, 0.02, 0.035, 0.018333, 0.026667]


@pytest.mark.parametrize(
    ("end", "is_held"), [(0.02, False), (0.03, True), (0.06, True), (-0.06, False)]
)
def test_a_post_in_the_midst_of_the_way_is_met(end: float, is_held: bool) -> None:
    judge, _ = careful(post)
    verdict = judge.limit(to(end), at(), 10.0)
    assert isinstance(verdict.command, Hold) is is_held
    if is_held:
        hold(verdict, "limit_collision", "hand and wall would be")
        assert verdict.acted == ("collision",)


def test_the_way_past_a_post_is_cut_before_it() -> None:
    judge, _ = careful(post, reactions=SCALE.reactions)
    verdict = judge.limit(to(0.064), at(), 10.0)
    assert verdict.acted == ("collision",)
    assert place(verdict)[0] == pytest.approx(0.024), "at 25 mm it would be 9.5 mm away"


def test_an_arm_near_a_post_may_leave_it_and_not_pass_it() -> None:
    for end, is_held in ((-0.02, False), (0.0695, True)):
        judge, _ = careful(post)
        verdict = judge.limit(to(end), at(0.025), 10.0)
        assert isinstance(verdict.command, Hold) is is_held


def test_an_arm_behind_its_setpoint_near_a_post_is_compared_with_where_it_is() -> None:
    judge, _ = careful(post)
    judge.follow(to(0.031), at(0.02), 10.0)
    verdict = judge.limit(to(0.034), at(0.02), 10.2)
    hold(verdict, "limit_collision", "hand and wall would be 8.5 mm apart")


def test_without_a_collision_profile_the_way_is_not_looked_at() -> None:
    gantry = Gantry(post)
    verdict = limiter(HOLD, profile(), gantry).limit(to(0.06), at(), 10.0)
    assert verdict.acted == ()
    assert gantry.places() == [0.0, 0.06]
