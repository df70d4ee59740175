"""Predicates: what callers may write, and true, false or not to be judged."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import Float64, Float64MultiArray, String

from rn_standard.tasks.feature import EXAMPLES
from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.monitor import Monitor, Score
from rn_standard.tasks.predicates import MonitorSays, parse_predicate
from rn_standard.tasks.run_task import judge_of
from rn_standard.tasks.snapshot import ArmSnapshot, Snapshot, StillClock
from roboneuron import ArmProfile, Pose, RobotProfile
from roboneuron.errors import InvalidInputError

TRUE = {"kind": "joints_in", "joints": {"a": [0, 1]}}
FALSE = {"kind": "joints_in", "joints": {"a": [2, 3]}}
BLIND = {"kind": "joints_in", "joints": {"absent": [0, 1]}}
HERE = Pose(position_m=np.array([0.5, 0.0, 0.3]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]))
NOW = Snapshot(
    now_s=10.0, joints={"a": 0.5, "finger": 0.02}, tcp=HERE, gripper_open=0.5, still_s=1.0
)


def judge(data: Any, **parts: Any) -> PredicateJudge:
    made = PredicateJudge(
        parse_predicate(data),
        "try",
        parts.pop("monitor_for", lambda named: pytest.fail("no monitor is named")),
        {"": "finger", "right": "other"},
    )
    made.reset(replace(NOW, now_s=0.0))
    return made


def value(data: Any, **changes: Any) -> bool | None:
    return judge(data).look(replace(NOW, **changes)).value


@pytest.mark.parametrize(
    ("kind", "parts", "expected"),
    [
        ("all", [TRUE, TRUE], True),
        ("all", [TRUE, BLIND], None),
        ("all", [BLIND, FALSE], False),
        ("any", [FALSE, TRUE], True),
        ("any", [BLIND, TRUE], True),
        ("any", [BLIND, FALSE], None),
        ("any", [FALSE, FALSE], False),
    ],
)
def test_parts_are_combined_as_by_kleene(
    kind: str, parts: list[Any], expected: bool | None
) -> None:
    assert value({"kind": kind, "of": parts}) is expected


def test_not_of_what_cannot_be_judged_cannot_be_judged() -> None:
    assert [value({"kind": "not", "of": part}) for part in (TRUE, FALSE, BLIND)] == [
        False,
        True,
        None,
    ]


@pytest.mark.parametrize(
    ("data", "changes", "expected"),
    [
        ({"kind": "tcp_in", "lower_m": [0, -1, 0], "upper_m": [1, 1, 1]}, {}, True),
        ({"kind": "tcp_in", "lower_m": [0, -1, 0.4], "upper_m": [1, 1, 1]}, {}, False),
        ({"kind": "tcp_in", "lower_m": [0, -1, 0], "upper_m": [1, 1, 1]}, {"tcp": None}, None),
        ({"kind": "gripper_holds"}, {}, True),
        ({"kind": "gripper_holds"}, {"gripper_open": 0.02}, False),
        ({"kind": "gripper_holds"}, {"gripper_open": 1.0}, False),
        ({"kind": "gripper_holds"}, {"gripper_open": None}, None),
        ({"kind": "gripper_holds", "least_effort": 5.0}, {}, None),
        ({"kind": "gripper_holds", "least_effort": 5.0}, {"effort": {"finger": -8.0}}, True),
        ({"kind": "gripper_holds", "least_effort": 5.0}, {"effort": {"finger": 2.0}}, False),
        ({"kind": "still", "for_s": 0.5}, {}, True),
        ({"kind": "still", "for_s": 2.0}, {}, False),
        ({"kind": "still", "for_s": 0.5}, {"still_s": None}, None),
        ({"kind": "policy_done"}, {"policy_done": True}, True),
        ({"kind": "policy_done"}, {"policy_done": False}, False),
        ({"kind": "policy_done"}, {}, None),
    ],
)
def test_what_is_measured_decides_and_what_is_not_leaves_it_open(
    data: Any, changes: dict[str, Any], expected: bool | None
) -> None:
    made = judge(data)
    made.look(replace(NOW, **changes))
    assert made.look(replace(NOW, **changes, now_s=11.0)).value is expected


def test_a_closing_gripper_passes_every_opening_and_holds_nothing() -> None:
    made = judge({"kind": "gripper_holds"})
    values = [
        made.look(replace(NOW, now_s=i * 0.1, gripper_open=1.0 - 0.08 * i)).value for i in range(12)
    ]
    assert True not in values


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ({"at_least": 1.0}, True),
        ({"at_most": 1.0}, False),
        ({"equals": 1.5}, True),
        ({"equals": "x"}, False),
    ],
)
def test_fields_of_messages(bounds: dict[str, Any], expected: bool) -> None:
    data = {
        "kind": "field",
        "topic": "t",
        "type": "std_msgs/msg/Float64",
        "field": "data",
        **bounds,
    }
    assert value(data, messages={"t": Float64(data=1.5)}) is expected
    assert value(data) is None
    assert value(data | {"field": "other"}, messages={"t": Float64(data=1.5)}) is None
    nan = value(
        data | {"at_least": -1e9, "equals": None}, messages={"t": Float64(data=float("nan"))}
    )
    assert nan is False


@pytest.mark.parametrize(
    "path",
    [
        "__class__.__init__.__globals__",
        "_data",
        "data.tolist",
        "data.__class__",
        "get_fields_and_field_types",
    ],
)
@pytest.mark.parametrize(
    "message", [Float64(data=1.5), Float64MultiArray(data=[1.0]), String(data="x")]
)
def test_nothing_but_the_fields_of_a_message_is_read(path: str, message: Any) -> None:
    data = {
        "kind": "field",
        "topic": "t",
        "type": "std_msgs/msg/Float64",
        "field": path,
        "equals": "x",
    }
    judgement = judge(data).look(replace(NOW, messages={"t": message}))
    assert judgement.value is None
    assert len(judgement.reason) < 200


def test_a_long_value_is_not_quoted_whole() -> None:
    data = {
        "kind": "field",
        "topic": "t",
        "type": "std_msgs/msg/String",
        "field": "data",
        "equals": "x",
    }
    judgement = judge(data).look(replace(NOW, messages={"t": String(data="y" * 10_000)}))
    assert judgement.value is False
    assert len(judgement.reason) < 200


def test_held_counts_from_the_last_break() -> None:
    made = judge({"kind": "held", "for_s": 1.0, "of": TRUE})
    places = [0.5, 0.5, 5.0, 0.5, 0.5, 0.5]
    values = [
        made.look(replace(NOW, now_s=i * 0.6, joints={"a": a})).value for i, a in enumerate(places)
    ]
    assert values == [False, False, False, False, False, True]


class Counting:
    def __init__(self) -> None:
        self.count = 0

    def reset(self, observation: Any) -> None:
        self.count = 0

    def score(self, observation: Any) -> Score:
        self.count += 1
        return Score(value=0.5, reason="half")


@pytest.mark.parametrize(("at_least", "expected"), [(0.5, True), (0.6, False)])
def test_a_monitors_score_is_held_against_its_bound(at_least: float, expected: bool) -> None:
    data = {"kind": "monitor", "name": "x", "at_least": at_least}
    made = judge(data, monitor_for=lambda named: Counting())
    assert made.look(NOW).value is expected


@pytest.mark.parametrize("data", EXAMPLES.values())
def test_the_examples_are_predicates(data: Any) -> None:
    parse_predicate(data)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ({"kind": "maybe"}, "until"),
        ({"kind": "all", "of": []}, "until.all.of"),
        ({"kind": "still", "for_s": -1}, "for_s"),
        ({"kind": "field", "topic": "t", "type": "std_msgs/msg/Bool", "field": "data"}, "at_least"),
        (
            {"kind": "not", "of": {"kind": "tcp_in", "lower_m": [0, 0], "upper_m": [1, 1, 1]}},
            "lower_m",
        ),
        ({"kind": "still", "for_s": 1, "extra": 1}, "extra"),
        ({"kind": "all", "of": [{"kind": "policy_done"}] * 40}, "more than 32"),
    ],
)
def test_what_is_no_predicate_is_refused_with_its_place(data: Any, text: str) -> None:
    with pytest.raises(InvalidInputError, match=re.escape(text)):
        parse_predicate(data)


def test_the_still_clock_begins_again_with_every_motion() -> None:
    clock = StillClock(least=0.01)
    assert clock.observe(0.0, {"a": 0.0}) == 0.0
    assert clock.observe(1.0, {"a": 0.001}) == 1.0
    assert clock.observe(2.0, {"a": 0.05}) == 0.0
    assert clock.observe(2.5, {"a": 0.05}) == 0.5


def test_predicates_look_at_the_arm_that_they_name() -> None:
    there = replace(HERE, position_m=np.array([0.9, 0.0, 0.3]))
    arms = {
        "left": ArmSnapshot(tcp=HERE, gripper_open=1.0),
        "right": ArmSnapshot(tcp=there, gripper_open=0.5),
    }
    box = {"kind": "tcp_in", "lower_m": [0.8, -1, 0], "upper_m": [1, 1, 1]}
    assert value(box, arms=arms) is False
    assert value({**box, "arm": "left"}, arms=arms) is False
    assert value({**box, "arm": "right"}, arms=arms) is True
    holds = {"kind": "gripper_holds", "least_effort": 2.0}
    effort = {"finger": 0.0, "other": 3.0}
    assert value({**holds, "arm": "left"}, arms=arms, effort=effort) is False
    of_right = judge({**holds, "arm": "right"})
    of_right.look(replace(NOW, now_s=9.0, arms=arms))
    assert of_right.look(replace(NOW, arms=arms, effort=effort)).value is True
    assert value({**box, "arm": "right"}, arms={}) is None


def test_each_gripper_has_to_stand_still_by_itself() -> None:
    def at(now_s: float, opening: float) -> Snapshot:
        return replace(NOW, now_s=now_s, arms={"right": ArmSnapshot(gripper_open=opening)})

    judge_of_right = judge({"kind": "gripper_holds", "arm": "right"})
    judge_of_right.reset(at(0.0, 0.8))
    assert judge_of_right.look(at(1.0, 0.5)).value is False, "it is moving"
    assert judge_of_right.look(at(1.5, 0.5)).value is True


def no_monitor(predicate: MonitorSays) -> Monitor:
    raise AssertionError(predicate)


def test_a_predicate_of_an_arm_that_is_not_there_is_refused() -> None:
    arms = tuple(
        ArmProfile(name=name, joints=(name,), base_link="b", tcp_link=name)
        for name in ("left", "right")
    )
    pair = RobotProfile(name="pair", arm_joints=("left", "right"), arms=arms)
    told = parse_predicate({"kind": "not", "of": {"kind": "gripper_holds", "arm": "middle"}})
    with pytest.raises(InvalidInputError, match="There is no arm 'middle'") as caught:
        judge_of(told, "try", pair, no_monitor)
    assert caught.value.hint == "The arms are: left, right."
    judge_of(parse_predicate({"kind": "gripper_holds", "arm": "right"}), "try", pair, no_monitor)
