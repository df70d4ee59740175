"""What the limits of control do: what the status tells, what the audit holds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import Hold, JointCommand
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import LimitedCommand, Motion
from roboneuron.modules.status import StatusWriter
from roboneuron.tools.arm import limit_reports
from roboneuron.tools.arm.limit_reports import LimitReports

ARM = ("a", "b")
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


class Bench:
    """What reports on one control, and what it has said."""

    def __init__(self, state: Path, clock: Clock) -> None:
        self.state = state
        self.clock = clock
        self.status = StatusWriter("/pair/control")
        settings = SimpleNamespace(state_directory=str(state))
        control = SimpleNamespace(
            profile=SimpleNamespace(name="pair"),
            status=self.status,
            node=SimpleNamespace(settings=settings),
        )
        self.reports = LimitReports(control)  # type: ignore[arg-type]

    def judge(self, limited: LimitedCommand, now_s: float) -> None:
        """Report what the limits say."""
        self.clock.now_s = now_s
        self.reports.note_limited(limited)

    def values(self) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.status.to_message().values}

    def records(self) -> list[dict[str, Any]]:
        path = self.state / "audit.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


class Clock:
    """Stands for the module `time`."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return 1_700_000_000_000_000_000


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    clock = Clock()
    monkeypatch.setattr(limit_reports, "time", clock)
    bench = Bench(tmp_path, clock)
    yield bench
    bench.reports.close()


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
    monkeypatch.setattr(limit_reports, "_CHANGE_PERIOD_S", 0.125)
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
    def write(record: object) -> None:
        raise RefusedError("The disk is full.")

    bench.reports._audit.write = write  # type: ignore[method-assign, assignment]
    bench.judge(scaled(), 10.0)
    assert dict(bench.status.dropped) == {"unrecorded": 1}
    assert "The disk is full." in caplog.text
