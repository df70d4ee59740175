"""A person who leads the arm during a task: it waits, goes on, or is done by that person."""

from __future__ import annotations

import pytest
from task_cell import FakeCell

from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.predicates import parse_predicate
from rn_standard.tasks.runner import Outcome, Task, TaskEnd, TaskPlan

LIFTED = {"kind": "joints_in", "joints": {"lift": [0.1, 1.0]}}
PLAN = TaskPlan(instruction="pick it up", max_s=10.0, max_attempts=1)


def run(cell: FakeCell, told: list[str]) -> TaskEnd:
    judge = PredicateJudge(
        parse_predicate(LIFTED), PLAN.instruction, lambda named: pytest.fail("no monitor is named")
    )
    return Task(cell, judge, PLAN, told.append).run()


def led_between(first_s: float, last_s: float, lifted_s: float) -> FakeCell:
    """A person leads for that time; the thing is lifted from `lifted_s` on."""

    def script(cell: FakeCell, t: float) -> dict[str, object]:
        cell.led = "Ada" if cell.began and first_s <= t < last_s else ""
        return {"joints": {"lift": 0.2 if cell.began and t >= lifted_s else 0.0}}

    return FakeCell(script=script)


def test_the_time_of_a_person_is_not_the_policys() -> None:
    told: list[str] = []
    end = run(led_between(5.0, 60.0, 64.0), told)
    assert (end.outcome, end.attempts) == (Outcome.SUCCEEDED, 1)
    assert end.took_s > 60.0
    assert any("Ada leads the arm; the policy waits" in line for line in told)
    assert any("handed back; the policy goes on" in line for line in told)


def test_what_is_left_of_the_time_counts_after_the_hand_back() -> None:
    end = run(led_between(5.0, 60.0, 1e9), [])
    assert end.outcome is Outcome.TIMED_OUT
    assert end.took_s == pytest.approx(65.0, abs=1.0)


def test_what_a_person_brings_about_is_no_success_of_the_policy() -> None:
    cell = led_between(2.0, 1e9, 20.0)
    end = run(cell, [])
    assert end.outcome is Outcome.TAKEN_OVER
    assert end.reason.startswith("Ada brought it about")
    assert not cell.moving


def test_a_person_who_leads_for_ever_ends_the_task() -> None:
    end = run(led_between(2.0, 1e9, 1e9), [])
    assert end.outcome is Outcome.TAKEN_OVER
    assert "has led for 600 s" in end.reason


def test_a_stop_while_a_person_leads_ends_the_task() -> None:
    cell = led_between(2.0, 1e9, 1e9)
    cell.on_wait = lambda it: setattr(it, "taken", "a stop" if it.time_s > 5.0 else "")
    assert run(cell, []).outcome is Outcome.STOPPED
