"""The judge of commands passes what the limiter of control sends, and no jump beside it."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from command_judge import SentCommand, in_order, judged, largest, noted

sys.path.pop(0)

from roboneuron import JointCommand, JointLimits, JointSample, Pose, RobotProfile
from roboneuron.contract import Posture
from roboneuron.gate.motion import MotionLimiter, MotionRules
from roboneuron.gate.motion.rules import LIMITS

NAMES = ("a", "b")
ONE = np.ones(2)
HARDEST = 10.0
JOINTS = JointLimits(
    lower=-3 * ONE, upper=3 * ONE, velocity=2 * ONE, acceleration=HARDEST * ONE, effort=ONE
)
PROFILE = RobotProfile(
    name="pair", base_link="base", arm_joints=NAMES, limits=JOINTS, home_rad=0 * ONE, cameras=()
)
PERIOD_S = 0.02


def pose(joints: JointSample) -> Pose:
    still = np.array([0, 0, 0, 1.0])
    return Pose(position_m=np.zeros(3), quaternion_xyzw=still, stamp_ns=joints.stamp_ns)


def posture(joints: JointSample) -> Posture:
    return Posture(pose=pose(joints))


def walked(seed: int, count: int = 300) -> list[SentCommand]:
    """Random rows, late and early, through the limiter of control; the arm follows at once."""
    random = np.random.default_rng(seed)
    rules = MotionRules(reactions=dict.fromkeys(LIMITS, "scale"))
    limiter = MotionLimiter(rules, PROFILE, pose, posture)
    now_s, place, found = 10.0, np.zeros(2), list[SentCommand]()
    for _ in range(count):
        now_s += random.uniform(0.4, 2.0) * PERIOD_S
        joints = JointSample(names=NAMES, position=place, stamp_ns=0)
        start = limiter.reference(joints, now_s).position
        wanted = np.clip(start + random.normal(0.0, 0.02, 2), -2.0, 2.0)
        asked = JointCommand(names=NAMES, position=wanted, duration_s=PERIOD_S)
        sent = limiter.limit(asked, joints, now_s).command
        assert isinstance(sent, JointCommand)
        place = limiter.reference(joints, now_s).position
        one = SentCommand(
            at_ns=round(now_s * 1e9),
            duration_s=sent.duration_s,
            target=sent.position,
            measured=joints.position,
        )
        found.append(one)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_what_the_limiter_sends_is_within_the_limits_to_their_last_thousandth(seed: int) -> None:
    commands = walked(seed)
    worst = largest(judged(commands, JOINTS), 0, commands[-1].at_ns)
    assert worst is not None
    assert worst.count == len(commands) - 1
    assert 0.99 < worst.acceleration < 1.001
    assert worst.velocity < 1.001


@pytest.mark.parametrize("by", [0.15, -0.15])
def test_a_jump_of_a_few_millimetres_at_the_joint_is_seen(by: float) -> None:
    commands = walked(0)
    jump = np.array([by * PERIOD_S * 2.0, 0.0])
    commands[150] = replace(commands[150], target=commands[150].target + jump)
    found = judged(commands, JOINTS)
    assert max(one.acceleration for one in found) > 1.1


def test_a_command_that_came_from_nowhere_is_counted_and_a_hold_is_known() -> None:
    notes = walked(0, 20)
    sent = [replace(one, at_ns=one.at_ns + 3_000_000) for one in notes]
    hold = SentCommand(at_ns=sent[9].at_ns + 1_000_000, duration_s=0.05, target=0.5 * ONE)
    foreign = replace(hold, duration_s=0.02)
    commands, unknown = in_order(notes, [*sent[:10], hold, *sent[10:]])
    assert (unknown, [one.is_hold for one in commands].count(True)) == (0, 1)
    assert commands[10].is_hold
    assert in_order(notes, [*sent[:10], foreign, *sent[10:]])[1] == 1


def test_a_hold_in_motion_tells_the_velocity_that_it_ended() -> None:
    moving = [
        SentCommand(
            at_ns=number * 20_000_000, duration_s=0.02, target=0.01 * number * ONE, measured=0 * ONE
        )
        for number in range(1, 5)
    ]
    hold = SentCommand(at_ns=95_000_000, duration_s=0.05, target=0.03 * ONE, is_hold=True)
    found = judged([*moving, hold], JOINTS)
    assert found[-1].held_rad_s == pytest.approx(0.5)


def test_notes_are_read_up_to_a_line_that_is_still_being_written(tmp_path: Path) -> None:
    def row(at: int, target: float) -> str:
        told = {"at_ns": at, "is_lost": False, "duration_s": 0.02}
        return json.dumps({**told, "target": [target], "measured": [0.0]})

    file = tmp_path / "notes"
    file.write_text("\n".join([row(12, 1.0), row(23, 2.0), row(35, 3.0)]) + '\n{"no')
    assert [(one.at_ns, one.target.tolist()) for one in noted(file, 20)] == [
        (23, [2.0]),
        (35, [3.0]),
    ]
