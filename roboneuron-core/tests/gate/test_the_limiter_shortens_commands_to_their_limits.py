"""Shortening of commands, repeated checks, and paths past bodies."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gantry import (
    HOLD,
    SCALE,
    STEP_S,
    Gantry,
    Near,
    at,
    hold,
    limiter,
    place,
    profile,
    sent,
    to,
)

from roboneuron.contract import (
    CollisionProfile,
    Hold,
    Obstacle,
)
from roboneuron.gate.motion import MotionLimiter, MotionRules


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


def moving(rules: MotionRules, speed_m_s: float = 1.0, x: float = 0.0) -> MotionLimiter:
    """A limiter of an arm with 4 m/s^2 that is at x at 10.0 s and moves up until 10.5 s."""
    judge = limiter(rules, profile(acceleration=4.0))
    for i in range(5):
        begin = x + i * STEP_S * speed_m_s
        judge.follow(to(begin + STEP_S * speed_m_s), at(begin), 10.0 + i * STEP_S)
    return judge


def test_an_arm_too_fast_for_its_position_limit_holds() -> None:
    judge = moving(SCALE, x=2.45)
    verdict = judge.limit(to(2.95), at(2.95), 10.5)
    # 1 m/s minus 4 m/s^2 for 0.1 s: it would move 0.06 m, and 0.05 m are left.
    hold(
        verdict,
        "limit_position",
        "No part of the command is within the limits: x would go to 3.0100",
    )
    assert verdict.acted == ("acceleration", "position")
    judge = moving(SCALE, x=2.44)
    assert sent(judge.limit(to(2.94), at(2.94), 10.5)).position[0] == pytest.approx(3.0)


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


def careful(near: Near, **values: Any) -> tuple[MotionLimiter, Gantry]:
    """Postures are checked every 10 mm."""
    gantry = Gantry(near)
    robot = profile(collision=CollisionProfile(min_distance_m=0.005))
    return limiter(replace(HOLD, **values), robot, gantry), gantry


def free(_: float) -> float:
    return 1.0


def post(x: float) -> float:
    """A post that is near along 11 mm of the path."""
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
