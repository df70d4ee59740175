"""What a monitor may do beside a task's predicate, and what it never does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import pytest
from monitors import Told, frame
from task_cell import FakeCell

from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.monitor import Score
from rn_standard.tasks.options import TaskMonitorOptions
from rn_standard.tasks.predicates import parse_predicate
from rn_standard.tasks.runner import Outcome, Task, TaskEnd, TaskPlan
from rn_standard.tasks.task_watch import TaskWatch
from roboneuron import Observation

PLAN = TaskPlan(instruction="pick it up", max_s=5.0, max_attempts=3)
LIFTED = {"kind": "joints_in", "joints": {"lift": [0.1, 1.0]}}
UNKNOWN = {"kind": "joints_in", "joints": {"absent": [0.1, 1.0]}}
YES = Score(value=0.97, reason="it is up", progress=1.0)
NO = Score(value=0.02, reason="it lies", progress=0.3)
LOST = Score(value=0.02, reason="another cube is up", failure=0.95)
Act = Literal["end", "fail", "confirm"]


def cell(lifts_at_s: float = 1e9, fresh: bool = True) -> FakeCell:
    """An arm that lifts after a time; its camera gives another picture at each look."""

    def script(cell: FakeCell, t: float) -> dict[str, object]:
        height = 0.2 if cell.began and t >= lifts_at_s else 0.0
        content = round(cell.time_s * 100) if fresh else 1
        seen = frame(content, cell.time_s if fresh else 0.0)
        return {"joints": {"lift": height}, "frames": {"primary": seen}}

    return FakeCell(script=script)


def run(
    robot: FakeCell,
    says: Callable[[Observation], Score | str],
    *acts: Act,
    until: object = LIFTED,
    notes: list[Mapping[str, object]] | None = None,
) -> TaskEnd:
    judge = PredicateJudge(
        parse_predicate(until), PLAN.instruction, lambda named: pytest.fail("no monitor is named")
    )
    found = [] if notes is None else notes
    watch = TaskWatch(
        Told(says), TaskMonitorOptions(name="m", acts=acts), PLAN.instruction, found.append
    )
    return Task(robot, judge, PLAN, lambda text: None, watch).run()


def test_it_reports_beside_the_outcome() -> None:
    robot = cell(2.0)
    end = run(robot, lambda seen: YES if robot.began and robot.time_s >= 2.0 else NO)
    assert end.outcome is Outcome.SUCCEEDED
    assert end.monitor is not None
    assert (end.monitor.says, end.monitor.agrees, end.monitor.value) == ("success", True, 0.97)
    assert end.monitor.answers > 5


def test_by_default_its_success_ends_nothing() -> None:
    notes: list[Mapping[str, object]] = []
    end = run(cell(), lambda seen: YES, notes=notes)
    assert (end.outcome, end.attempts) == (Outcome.TIMED_OUT, 3)
    assert end.monitor is not None
    assert end.monitor.agrees is False
    assert len(notes) == 3, "one event for each attempt"
    assert notes[0] | {"predicate_reason": ""} == {
        "instruction": "pick it up",
        "monitor": "m",
        "says": "success",
        "reason": "it is up",
        "predicate": False,
        "predicate_reason": "",
    }


def test_by_default_its_failure_ends_nothing() -> None:
    end = run(cell(4.0), lambda seen: LOST)
    assert (end.outcome, end.attempts) == (Outcome.SUCCEEDED, 1)
    assert end.monitor is not None
    assert (end.monitor.says, end.monitor.agrees) == ("failure", False)


def test_its_success_may_end_what_no_predicate_can_judge() -> None:
    assert run(cell(), lambda seen: YES, until=UNKNOWN).outcome is Outcome.UNCLEAR
    robot = cell()
    end = run(robot, lambda seen: YES if robot.time_s >= 2.0 else NO, "end", until=UNKNOWN)
    assert (end.outcome, end.attempts) == (Outcome.SUCCEEDED, 1)
    assert end.reason == "m says success: it is up"
    assert end.took_s < 3.0


def test_its_success_never_overrules_a_predicate() -> None:
    assert run(cell(), lambda seen: YES, "end", "fail", "confirm").outcome is Outcome.TIMED_OUT


def test_a_success_that_does_not_last_at_rest_is_none() -> None:
    robot = cell()
    end = run(robot, lambda seen: YES if robot.moving else NO, "end", until=UNKNOWN)
    assert end.outcome is Outcome.UNCLEAR
    assert "for a moment" in end.reason


def test_its_failure_may_end_the_task_without_another_attempt() -> None:
    robot = cell()
    end = run(robot, lambda seen: LOST if robot.time_s >= 1.0 else NO, "fail")
    assert (end.outcome, end.attempts, robot.began) == (Outcome.FAILED, 1, 1)
    assert end.reason == "m says failure: another cube is up"
    assert not robot.moving


def test_an_unconfirmed_predicate_may_be_unclear() -> None:
    end = run(cell(1.0), lambda seen: NO, "confirm")
    assert (end.outcome, end.attempts) == (Outcome.UNCLEAR, 1)
    assert "but m says not_yet: it lies" in end.reason
    assert run(cell(1.0), lambda seen: YES, "confirm").outcome is Outcome.SUCCEEDED


def test_an_absent_monitor_changes_nothing() -> None:
    end = run(cell(1.0), lambda seen: "it has failed", "end", "fail", "confirm")
    assert end.outcome is Outcome.SUCCEEDED
    assert end.monitor is not None
    assert (end.monitor.says, end.monitor.reason) == ("absent", "it has failed")
    assert end.monitor.agrees is None


def test_a_frozen_camera_never_yields_success() -> None:
    end = run(cell(fresh=False), lambda seen: YES, "end", until=UNKNOWN)
    assert end.outcome is Outcome.UNCLEAR
    assert end.monitor is not None
    assert end.monitor.says == "absent"
    assert "s old" in end.monitor.reason


def test_without_a_picture_it_is_absent() -> None:
    end = run(FakeCell(script=lambda cell, t: {}), lambda seen: YES, "end", until=UNKNOWN)
    assert end.monitor is not None
    assert (end.outcome, end.monitor.says) == (Outcome.UNCLEAR, "absent")
    assert "no picture" in end.monitor.reason


def test_an_unsure_monitor_gets_a_moment_at_the_end() -> None:
    robot = cell(1.0)

    def says(seen: Observation) -> Score:
        ended = robot.ended_s is not None and robot.time_s > robot.ended_s + 0.5
        return YES if ended else NO

    end = run(robot, says)
    assert end.monitor is not None
    assert (end.outcome, end.monitor.says) == (Outcome.SUCCEEDED, "success")
    assert end.took_s == pytest.approx(1.6, abs=0.3)
