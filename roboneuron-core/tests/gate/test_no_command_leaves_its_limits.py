"""The limits on control's commands, tested with a planar arm of two joints."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from planar import (
    HOLD,
    SCALE,
    START,
    STEP_S,
    command,
    forward,
    hold,
    limiter,
    place,
    profile,
    sample,
    sent,
)

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    Hold,
    JointCommand,
    JointSample,
    Obstacle,
    Posture,
    Workspace,
)
from roboneuron.errors import ConfigurationError, UnsafeError
from roboneuron.gate.motion import LIMITS, MotionLimiter, MotionRules, motion_rules


def test_command_within_all_limits_is_sent_as_it_is() -> None:
    asked = command(START + np.array([0.02, -0.02]))
    verdict = limiter(MotionRules(reactions=HOLD)).limit(asked, sample(START), 1.0)
    assert verdict.command is asked
    assert verdict.acted == ()
    assert verdict.share == 1.0
    assert verdict.sent == verdict.asked
    assert verdict.asked is not None
    assert verdict.asked.joint_speed == pytest.approx(0.2)


CASES = {
    "position": (MotionRules(reactions=HOLD), np.array([1.9, 0.5]), np.array([0.2, 0.0]), 10.0),
    "velocity": (MotionRules(reactions=HOLD), START, np.array([0.45, 0.0]), 0.3),
    "acceleration": (MotionRules(reactions=HOLD), START, np.array([0.05, 0.0]), STEP_S),
    "step": (MotionRules(reactions=HOLD, max_step_m=0.01), START, np.array([0.03, 0.0]), STEP_S),
    "speed": (MotionRules(reactions=HOLD, max_speed_m_s=0.1), START, np.array([0.03, 0.0]), STEP_S),
    "workspace": (
        MotionRules(reactions=HOLD, upper_m=place(START) + 0.001),
        START,
        np.array([-0.03, 0.0]),
        STEP_S,
    ),
    "zone": (
        MotionRules(
            reactions=HOLD,
            zones=(
                Obstacle(
                    name="vase",
                    lower_m=place(START) - [0.02, 1, 1],
                    upper_m=place(START) - [0.01, -1, -1],
                ),
            ),
        ),
        START,
        np.array([0.03, 0.0]),
        STEP_S,
    ),
    "height": (
        MotionRules(reactions=HOLD, min_height_m=float(place(START)[2]) - 0.001),
        START,
        np.array([-0.03, -0.03]),
        STEP_S,
    ),
    "singularity": (
        MotionRules(reactions=HOLD, min_singular_value=0.278),
        START,
        np.array([0.0, -0.03]),
        STEP_S,
    ),
    "collision": (
        MotionRules(reactions=HOLD),
        np.array([0.0, 2.39]),
        np.array([0.0, 0.03]),
        STEP_S,
    ),
}


@pytest.mark.parametrize("name", LIMITS)
def test_each_limit_holds_by_its_name(name: str) -> None:
    rules, start, way, duration_s = CASES[name]
    verdict = limiter(rules).limit(command(start + way, duration_s), sample(start), 1.0)
    assert hold(verdict).code == f"limit_{name}"
    assert verdict.acted == (name,)
    assert verdict.reason


@pytest.mark.parametrize("name", LIMITS)
def test_each_limit_can_refuse_and_send_nothing(name: str) -> None:
    rules, start, way, duration_s = CASES[name]
    verdict = limiter(replace(rules, reactions=HOLD | {name: "refuse"})).limit(
        command(start + way, duration_s), sample(start), 1.0
    )
    assert verdict.command is None
    assert verdict.acted == (name,)


@pytest.mark.parametrize("name", LIMITS)
def test_each_limit_can_shorten_the_command_in_its_direction(name: str) -> None:
    rules, start, way, duration_s = CASES[name]
    verdict = limiter(replace(rules, reactions=HOLD | {name: "scale"})).limit(
        command(start + way, duration_s), sample(start), 1.0
    )
    moved = sent(verdict).position - start
    assert verdict.acted == (name,)
    assert 0.0 < verdict.share < 1.0
    # the same direction, exactly
    np.testing.assert_allclose(moved, verdict.share * way, atol=1e-12)
    again = limiter(replace(rules, reactions=HOLD | {name: "hold"})).limit(
        command(start + moved, duration_s), sample(start), 1.0
    )
    assert again.acted == (), "the shortened command is within the limit"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
def test_numbers_that_are_not_finite_hold(bad: float) -> None:
    judge = limiter()
    for verdict in (
        judge.limit(command([bad, 1.0]), sample(START), 1.0),
        judge.limit(command(START), sample([1.0, bad]), 1.0),
    ):
        assert hold(verdict).code == "unsafe_command"
    if not math.isfinite(bad):
        assert hold(judge.limit(command(START, bad), sample(START), 1.0)).code == "unsafe_command"


@pytest.mark.parametrize(
    ("names", "position"),
    [
        (("a",), [0.3]),
        (("a", "a"), [0.3, 0.3]),
        (("a", "b", "c"), [0.3, 1.2, 0.0]),
        (("a", "b"), [0.3]),
    ],
    ids=["missing", "twice", "unknown", "short"],
)
def test_commands_for_other_joints_hold(names: tuple[str, ...], position: list[float]) -> None:
    verdict = limiter().limit(
        JointCommand(names=names, position=np.array(position), duration_s=STEP_S),
        sample(START),
        1.0,
    )
    assert hold(verdict).code == "unsafe_command"


def test_missing_measured_joint_holds() -> None:
    measured = JointSample(names=("b", "c"), position=np.array([1.2, 0.0]))
    assert "lack ['a']" in hold(limiter().limit(command(START), measured, 1.0)).reason


def test_posture_that_cannot_be_judged_holds() -> None:
    def fail(joints: JointSample) -> Posture:
        raise UnsafeError("The robot description is gone.")

    judge = MotionLimiter(MotionRules(reactions=SCALE), profile(), forward, fail)
    assert (
        hold(judge.limit(command(START), sample(START), 1.0)).reason
        == "The robot description is gone."
    )


@pytest.mark.parametrize(
    ("opening", "is_held"), [(0.02, False), (0.041, True), (-0.01, True), (math.nan, True)]
)
def test_gripper_stays_within_its_travel(opening: float, is_held: bool) -> None:
    asked = JointCommand(
        names=("a", "b", "finger"), position=np.array([*START, opening]), duration_s=STEP_S
    )
    verdict = limiter().limit(asked, sample(START), 1.0)
    assert isinstance(verdict.command, Hold) == is_held


def test_shortening_the_arm_leaves_the_gripper_alone_and_the_order_of_names() -> None:
    asked = JointCommand(
        names=("finger", "b", "a"), position=np.array([0.03, 1.2, 1.0]), duration_s=STEP_S
    )
    moved = sent(limiter().limit(asked, sample(START), 1.0))
    assert moved.names == asked.names
    assert moved.position[0] == 0.03
    assert moved.position[1] == 1.2
    assert START[0] < moved.position[2] < 1.0


def test_way_through_a_thin_zone_is_seen() -> None:
    tcp = place(START)
    zone = Obstacle(name="pane", lower_m=tcp - [0.0102, 1, 1], upper_m=tcp - [0.01, -1, -1])
    verdict = limiter(MotionRules(reactions=HOLD, zones=(zone,))).limit(
        command(START + np.array([0.03, 0.0])), sample(START), 1.0
    )
    assert "'pane'" in hold(verdict).reason


@pytest.mark.parametrize(
    ("way", "is_held"), [([0.02, 0.0], True), ([-0.02, 0.0], False), ([0.0, 0.0], True)]
)
def test_only_ways_out_lead_out_of_a_forbidden_place(way: list[float], is_held: bool) -> None:
    # Outside the workspace at the low side of x: more of joint a moves the TCP to lower x.
    lower = place(START) + np.array([0.005, -9.0, -9.0])
    verdict = limiter(MotionRules(reactions=HOLD, lower_m=lower)).limit(
        command(START + way), sample(START), 1.0
    )
    assert isinstance(verdict.command, Hold) == is_held


def test_arm_that_moves_fast_turns_no_faster_than_it_can() -> None:
    judge, position, now_s = limiter(), START.copy(), 1.0
    for _ in range(4):
        position = sent(
            judge.limit(command(position + np.array([0.09, 0.0])), sample(position), now_s)
        ).position
        now_s += STEP_S
    verdict = judge.limit(command(position - [0.09, 0.0]), sample(position), now_s - 0.06)
    moved = sent(verdict)
    assert verdict.acted == ("acceleration",)
    # 0.9 rad/s before, at most 4 rad/s^2 for 0.04 s: still moving on, from the position reached by
    # the command.
    assert moved.position[0] > position[0] - 0.06 * 0.9
    assert moved.position[1] == pytest.approx(START[1])


def test_arm_that_does_not_follow_is_met_where_it_is() -> None:
    judge = limiter()
    sent(judge.limit(command(START + np.array([0.03, 0.0])), sample(START), 1.0))
    elsewhere = START + np.array([0.0, 0.4])
    verdict = judge.limit(command(elsewhere + np.array([0.01, 0.0])), sample(elsewhere), 1.1)
    assert verdict.reference_lost
    np.testing.assert_allclose(sent(verdict).position, elsewhere + np.array([0.01, 0.0]))


def test_hundredfold_rate_does_not_make_the_arm_faster() -> None:
    """Every 1 ms a command adds 0.1 rad; the arm follows exactly."""
    judge, position, now_s, travelled = limiter(), START.copy(), 1.0, 0.0
    for _ in range(500):
        verdict = judge.limit(
            command(position + np.array([0.1, 0.0]), 0.02), sample(position), now_s
        )
        target = sent(verdict)
        step = (target.position - position) * (0.001 / target.duration_s)
        assert abs(step[0]) <= 1.0 * 0.001 * 1.001
        position, now_s, travelled = position + step, now_s + 0.001, travelled + abs(step[0])
    assert 0.3 < travelled <= 0.5


def test_limits_of_a_configuration_can_only_be_tightened() -> None:
    robot = replace(profile(), workspace=None)
    rules = motion_rules(LimitsConfig(min_height_m=0.2, on_zone="refuse"), robot)
    assert rules.min_height_m == 0.2
    assert rules.reactions["zone"] == "refuse"
    box = replace(robot, workspace=Workspace(lower_m=np.zeros(3), upper_m=np.ones(3)))
    assert motion_rules(LimitsConfig(workspace_upper_m=[0.5, 0.5, 0.5]), box).upper_m.tolist() == [
        0.5,
        0.5,
        0.5,
    ]
    with pytest.raises(ConfigurationError, match="only be tightened"):
        motion_rules(LimitsConfig(workspace_lower_m=[-0.1, 0.0, 0.0]), box)
    with pytest.raises(ConfigurationError, match="no box"):
        motion_rules(
            LimitsConfig(workspace_lower_m=[0.5, 0.5, 0.5], workspace_upper_m=[0.4, 0.9, 0.9]), box
        )
    zones = ({"name": "vase", "lower_m": [0.0, 0.0, 0.0], "upper_m": [0.0, 1.0, 1.0]},)
    with pytest.raises(ConfigurationError, match="'vase'"):
        motion_rules(LimitsConfig.model_validate({"zones": zones}), robot)


def test_other_rules_hold_from_the_next_command_on() -> None:
    judge = limiter(MotionRules(reactions=SCALE, max_speed_m_s=0.5))
    asked = command(START + np.array([0.03, 0.0]))
    assert judge.limit(asked, sample(START), 1.0).acted == ()
    judge.use(MotionRules(reactions=SCALE, max_speed_m_s=0.1))
    judge.rest(sample(START), 2.0)
    assert judge.limit(asked, sample(START), 2.1).acted == ("speed",)
