"""The last word on a command: what is sent of it, what the status tells, what the audit holds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    CollisionProfile,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
)
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.gate.motion import LimitedCommand, Motion
from roboneuron.modules import motion as motion_module
from roboneuron.modules.motion import MotionGuard
from roboneuron.modules.status import StatusWriter

ARM = ("a", "b")
ONE = np.ones(2)
PROFILE = RobotProfile(
    name="pair",
    base_link="base",
    arm_joints=ARM,
    limits=JointLimits(lower=-ONE, upper=ONE, velocity=ONE, acceleration=ONE, effort=ONE),
    home_rad=np.zeros(2),
    cameras=(),
)
HERE = JointSample(names=ARM, position=np.array([0.5, -0.5]), stamp_ns=3)
ASKED = Motion(step_m=0.1234567, step_rad=0.2, speed_m_s=0.3, turn_rad_s=0.4, joint_speed=0.5)
SENT = Motion(
    step_m=0.01,
    step_rad=0.02,
    speed_m_s=0.03,
    turn_rad_s=0.04,
    joint_speed=0.05,
    smallest_singular_value=0.06,
)


def command(*position: float, duration_s: float = 0.1) -> JointCommand:
    return JointCommand(names=ARM, position=np.array(position), duration_s=duration_s)


class Controller:
    """The TCP moves by as many metres as the first joint."""

    def forward(self, joints: JointSample) -> Pose:
        return Pose(
            position_m=np.array([joints.position[0], 0.0, 0.0]),
            quaternion_xyzw=np.array([0, 0, 0, 1.0]),
            stamp_ns=joints.stamp_ns,
        )


class Inspector(Controller):
    """One that knows distances."""

    def inspect(self, joints: JointSample) -> Posture:
        pose = self.forward(joints)
        return Posture(pose=pose, smallest_singular_value=1.0, near=())


class Bench:
    """A guard, and what it has said."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.status = StatusWriter("/pair/control")
        self.guard: MotionGuard | None = None

    def make(
        self,
        limits: LimitsConfig | None = None,
        *,
        profile: RobotProfile = PROFILE,
        controller: Any = None,
        immediate: bool = False,
        longest_s: float = 2.0,
    ) -> MotionGuard:
        self.guard = MotionGuard(
            limits or LimitsConfig(),
            profile,
            controller or Controller(),
            self.status,
            self.state,
            immediate=immediate,
            longest_s=longest_s,
        )
        return self.guard

    def judge(self, verdict: LimitedCommand, now_s: float) -> JointCommand | Hold | None:
        """Have it pass on what the limits say."""
        guard = self.guard or self.make()
        guard._limiter.limit = lambda command, joints, now_s: verdict  # type: ignore[method-assign]
        return guard.judge(command(0.5, -0.5), HERE, now_s)

    def values(self) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.status.to_message().values}

    def records(self) -> list[dict[str, Any]]:
        path = self.state / "audit.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    if bench.guard is not None:
        bench.guard.close()


def scaled(*names: str, reason: str = "too fast") -> LimitedCommand:
    return LimitedCommand(
        command=command(0.51, -0.5),
        acted=names or ("velocity",),
        reason=reason,
        share=0.25,
        asked=ASKED,
        sent=SENT,
    )


HELD = LimitedCommand(
    command=Hold(code="limit_zone", reason="a vase"),
    acted=("zone",),
    reason="a vase",
    share=0.0,
    asked=ASKED,
)
UNSAFE = LimitedCommand(
    command=Hold(code="unsafe_command", reason="not a number"), reason="not a number", share=0.0
)
REFUSED = LimitedCommand(
    command=None, acted=("speed", "zone"), reason="a vase", share=0.0, asked=ASKED
)
PASSED = LimitedCommand(command=command(0.5, -0.5), asked=SENT, sent=SENT)


def test_a_command_is_sent_within_the_limits_of_the_configuration(bench: Bench) -> None:
    guard = bench.make(LimitsConfig(velocity_fraction=0.05))
    guard.rest(HERE, 10.0)
    sent = guard.judge(command(0.59, -0.5), HERE, 10.1)
    assert isinstance(sent, JointCommand)
    assert 0.0 < sent.position[0] - 0.5 <= 0.05 * 0.1 + 1e-12


def test_other_limits_hold_from_the_next_command_on(bench: Bench) -> None:
    guard = bench.make()
    guard.use(LimitsConfig(velocity_fraction=0.05))
    guard.rest(HERE, 10.0)
    sent = guard.judge(command(0.59, -0.5), HERE, 10.1)
    assert isinstance(sent, JointCommand)
    assert 0.0 < sent.position[0] - 0.5 <= 0.05 * 0.1 + 1e-12


def test_limits_that_do_not_fit_the_robot_are_refused(bench: Bench) -> None:
    wrong = LimitsConfig(workspace_lower_m=[1.0, 0.0, 0.0], workspace_upper_m=[0.0, 1.0, 1.0])
    with pytest.raises(ConfigurationError):
        bench.make(wrong)
    with pytest.raises(ConfigurationError):
        bench.make().use(wrong)


def test_a_command_that_lasts_longer_than_allowed_is_answered_with_a_hold(bench: Bench) -> None:
    answer = bench.make(longest_s=0.5).judge(command(0.5, -0.5, duration_s=0.6), HERE, 10.0)
    assert isinstance(answer, Hold)
    assert answer.code == "long_command"


def test_a_hold_ends_what_was_sent_before(bench: Bench) -> None:
    """The next command begins at rest where the arm is measured."""
    guard = bench.make()
    guard.rest(HERE, 10.0)
    assert guard._limiter._sent is not None
    assert guard._limiter._sent.start.tolist() == [0.5, -0.5]
    guard.rest(None, 10.0)
    assert guard._limiter._sent is None


def test_the_setpoint_of_the_predecessor_is_taken_over(bench: Bench) -> None:
    guard = bench.make()
    guard.follow(command(0.52, -0.5), HERE, 10.0)
    assert guard._limiter._sent is not None
    assert guard._limiter._sent.displacement == pytest.approx([0.02, 0.0])


def test_commands_without_a_time_are_judged_as_jumps(bench: Bench) -> None:
    assert bench.make(immediate=True)._limiter._immediate
    assert not bench.make()._limiter._immediate


@pytest.mark.parametrize("answer", [PASSED, scaled(), HELD, UNSAFE, REFUSED])
def test_what_the_limits_say_is_what_is_sent(bench: Bench, answer: LimitedCommand) -> None:
    assert bench.judge(answer, 10.0) is answer.command


def test_what_was_asked_and_what_was_sent_are_told(bench: Bench) -> None:
    bench.judge(scaled(), 10.0)
    values = bench.values()
    told = {key: value for key, value in values.items() if key.startswith(("asked_", "sent_"))}
    assert told == {
        "asked_step_m": "0.123457",
        "asked_step_rad": "0.2",
        "asked_speed_m_s": "0.3",
        "asked_joint_speed": "0.5",
        "sent_step_m": "0.01",
        "sent_step_rad": "0.02",
        "sent_speed_m_s": "0.03",
        "sent_joint_speed": "0.05",
        "sent_singular_value": "0.06",
        "sent_share": "0.25",
    }
    assert values["limit"] == "too fast"


def test_each_limit_is_counted_for_itself(bench: Bench) -> None:
    bench.judge(scaled("velocity", "speed"), 10.0)
    bench.judge(scaled("speed"), 10.0)
    bench.judge(PASSED, 10.0)
    values = bench.values()
    assert (values["limited.velocity"], values["limited.speed"]) == ("1", "2")
    assert values["limit"] == "too fast", "the last one"
    assert not [key for key in values if key.startswith("dropped.")]
    assert "reference_lost" not in values


def test_a_lost_setpoint_is_counted(bench: Bench) -> None:
    for count in ("1", "2"):
        bench.judge(replace(PASSED, reference_lost=True), 10.0)
        assert bench.values()["reference_lost"] == count


def test_a_refused_command_is_dropped_for_its_last_limit(bench: Bench) -> None:
    bench.judge(REFUSED, 10.0)
    assert bench.status.dropped.items() == {"limit_zone": 1}
    bench.judge(HELD, 10.0)
    assert bench.status.dropped.items() == {"limit_zone": 1}, "a hold is counted by control"


# The audit


def test_a_scaled_command_is_recorded_with_its_numbers(bench: Bench) -> None:
    bench.judge(scaled("velocity", "speed"), 10.0)
    (record,) = bench.records()
    kept = ("who", "role", "tool", "verdict", "robot", "endpoint", "rule", "reason", "arguments")
    assert {key: record.get(key, "") for key in kept} == {
        "who": "control",
        "role": "",
        "tool": "action",
        "verdict": "scaled",
        "robot": "pair",
        "endpoint": "action",
        "rule": "velocity, speed",
        "reason": "too fast",
        "arguments": {
            "asked": {
                "step_m": 0.123457,
                "step_rad": 0.2,
                "speed_m_s": 0.3,
                "turn_rad_s": 0.4,
                "joint_speed": 0.5,
            },
            "sent": {
                "step_m": 0.01,
                "step_rad": 0.02,
                "speed_m_s": 0.03,
                "turn_rad_s": 0.04,
                "joint_speed": 0.05,
                "smallest_singular_value": 0.06,
            },
            "counts": {"velocity": 1, "speed": 1},
        },
    }


@pytest.mark.parametrize(
    ("verdict", "word", "rule"),
    [
        (HELD, "held", "zone"),
        (UNSAFE, "held", "unsafe_command"),
        (REFUSED, "refused", "speed, zone"),
    ],
)
def test_a_command_that_is_not_sent_is_recorded_with_why(
    bench: Bench, verdict: LimitedCommand, word: str, rule: str
) -> None:
    bench.judge(verdict, 10.0)
    (record,) = bench.records()
    assert (record["verdict"], record["rule"], record["reason"]) == (word, rule, verdict.reason)
    assert "sent" not in record["arguments"]


def test_a_reason_without_a_rule_is_recorded_without_one(bench: Bench) -> None:
    bench.judge(replace(PASSED, reason="odd"), 10.0)
    (record,) = bench.records()
    assert record.get("rule", "") == ""


def test_a_command_that_passes_is_not_recorded(bench: Bench) -> None:
    bench.judge(PASSED, 10.0)
    assert bench.records() == []


def test_a_limit_that_goes_on_acting_is_recorded_once_a_second(bench: Bench) -> None:
    for now_s in (10.0, 10.5, 10.999, 11.0, 11.5, 12.0):
        bench.judge(scaled(), now_s)
    assert [record["arguments"]["counts"]["velocity"] for record in bench.records()] == [1, 4, 6]


def test_a_change_is_recorded_at_once_and_ten_times_a_second_at_most(bench: Bench) -> None:
    bench.judge(scaled(), 8.0)
    bench.judge(scaled("speed"), 8.0625)
    bench.judge(scaled("speed"), 8.125)
    bench.judge(HELD, 8.25)
    bench.judge(replace(HELD, command=None), 8.375)
    assert [(record["rule"], record["verdict"]) for record in bench.records()] == [
        ("velocity", "scaled"),
        ("speed", "scaled"),
        ("zone", "held"),
        ("zone", "refused"),
    ]


def test_a_change_exactly_a_tenth_of_a_second_later_is_recorded(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion_module, "_CHANGE_PERIOD_S", 0.125)
    bench.judge(scaled(), 8.0)
    bench.judge(scaled("speed"), 8.125)
    assert len(bench.records()) == 2


def test_a_guard_that_is_new_records_at_once_whatever_the_clock_says(bench: Bench) -> None:
    """The monotonic clock begins at 0 when a machine starts."""
    bench.judge(scaled(), 0.15)
    assert len(bench.records()) == 1


def test_an_audit_that_cannot_be_written_is_counted_and_told(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    guard = bench.make()

    def write(record: object) -> None:
        raise RefusedError("The disk is full.")

    guard._audit.write = write  # type: ignore[method-assign, assignment]
    answer = scaled()
    assert bench.judge(answer, 10.0) is answer.command
    assert bench.status.dropped.items() == {"unrecorded": 1}
    assert "The disk is full." in caplog.text


def test_the_audit_is_closed_with_the_guard(bench: Bench) -> None:
    bench.judge(scaled(), 10.0)
    assert bench.guard is not None
    assert bench.guard._audit._descriptor >= 0
    bench.guard.close()
    assert bench.guard._audit._descriptor < 0


# Whether collisions are checked


WITH_COLLISION = replace(PROFILE, collision=CollisionProfile())


@pytest.mark.parametrize(
    ("profile", "controller", "is_checked", "is_warned"),
    [
        (PROFILE, Controller(), "false", False),
        (PROFILE, Inspector(), "false", False),
        (WITH_COLLISION, Inspector(), "true", False),
        (WITH_COLLISION, Controller(), "false", True),
    ],
)
def test_it_is_told_whether_collisions_are_checked(
    bench: Bench,
    caplog: pytest.LogCaptureFixture,
    profile: RobotProfile,
    controller: Controller,
    is_checked: str,
    is_warned: bool,
) -> None:
    bench.make(profile=profile, controller=controller)
    assert bench.values()["collision_checked"] == is_checked
    assert ("collisions of pair are not checked" in caplog.text) == is_warned
