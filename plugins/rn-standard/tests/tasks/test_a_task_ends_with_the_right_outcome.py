"""run_task's outcomes, attempt by attempt, on a robot with a clock of its own."""

from __future__ import annotations

import pytest
from task_cell import PICTURE, FakeCell

from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.predicates import parse_predicate
from rn_standard.tasks.runner import Outcome, Task, TaskEnd, TaskPlan
from roboneuron.errors import NotReadyError

LIFTED = {"kind": "joints_in", "joints": {"lift": [0.1, 1.0]}}
PLAN = TaskPlan(instruction="pick it up", max_s=10.0, max_attempts=3)


def run(
    cell: FakeCell, until: object = LIFTED, plan: TaskPlan = PLAN, told: list[str] | None = None
) -> TaskEnd:
    judge = (
        None
        if until is None
        else PredicateJudge(
            parse_predicate(until),
            plan.instruction,
            lambda named: pytest.fail("no monitor is named"),
        )
    )
    said = [] if told is None else told
    return Task(cell, judge, plan, said.append).run()


def lift(height: float) -> dict[str, object]:
    return {"joints": {"lift": height}}


def test_a_true_predicate_ends_the_motion_and_is_looked_at_again_at_rest() -> None:
    cell = FakeCell(script=lambda cell, t: lift(0.2 if cell.began and t >= 2.0 else 0.0))
    told: list[str] = []
    end = run(cell, told=told)
    assert (end.outcome, end.attempts) == (Outcome.SUCCEEDED, 1)
    assert not cell.moving
    assert end.stop_s == pytest.approx(0.0)
    assert cell.ended_s == pytest.approx(2.0, abs=PLAN.period_s + 1e-6)
    assert end.before == end.after == (PICTURE,)
    assert told[0].startswith("attempt 1 of 3")
    assert told[-1].startswith("succeeded")


def test_what_is_done_already_moves_nothing() -> None:
    cell = FakeCell(script=lambda cell, t: lift(0.2))
    end = run(cell)
    assert (end.outcome, end.attempts, cell.began) == (Outcome.SUCCEEDED, 0, 0)


def test_another_attempt_follows_a_failed_one() -> None:
    def script(cell: FakeCell, t: float) -> dict[str, object]:
        cell.failure = "the gripper closed on nothing" if cell.began < 3 and t > 1 else ""
        return lift(0.2 if cell.began == 3 and t > 1 else 0.0)

    cell = FakeCell(script=script)
    end = run(cell)
    assert (end.outcome, end.attempts) == (Outcome.SUCCEEDED, 3)


def test_an_error_that_heals_ends_no_attempt() -> None:
    def script(cell: FakeCell, t: float) -> dict[str, object]:
        cell.failure = "a late image" if 1 < t < 1 + PLAN.give_up_s / 2 else ""
        return lift(0.2 if cell.began and t > 6 else 0.0)

    assert run(FakeCell(script=script)).attempts == 1


def test_after_the_last_attempt_the_task_has_failed() -> None:
    cell = FakeCell(script=lambda cell, t: lift(0.0) | {"policy_done": t > 1})
    end = run(cell)
    assert (end.outcome, end.attempts) == (Outcome.FAILED, 3)
    assert "says that it has finished" in end.reason


def test_time_that_is_over_is_told_as_such() -> None:
    end = run(FakeCell(script=lambda cell, t: lift(0.0)))
    assert (end.outcome, end.attempts) == (Outcome.TIMED_OUT, 3)
    assert end.took_s == pytest.approx(30.0, abs=1.0)


def test_what_falls_once_the_arm_stops_is_no_success() -> None:
    cell = FakeCell(script=lambda cell, t: lift(0.2 if cell.moving and t > 1 else 0.0))
    end = run(cell)
    assert (end.outcome, end.attempts) == (Outcome.FAILED, 3)
    assert "not any more" in end.reason


def test_an_arm_that_does_not_come_to_rest_is_unclear() -> None:
    cell = FakeCell(
        script=lambda cell, t: lift(0.2 if cell.began and t > 1 else 0.0) | {"still_s": 0.0}
    )
    assert run(cell).outcome is Outcome.UNCLEAR


@pytest.mark.parametrize(
    "fields", [{"policy_done": True}, {}], ids=["the policy ends", "time ends"]
)
def test_what_cannot_be_judged_is_unclear_and_not_tried_again(fields: dict[str, object]) -> None:
    end = run(FakeCell(script=lambda cell, t: {"joints": None} | fields))
    assert (end.outcome, end.attempts) == (Outcome.UNCLEAR, 1)


def test_without_a_predicate_nothing_is_a_success() -> None:
    end = run(FakeCell(script=lambda cell, t: {"policy_done": t > 1}), until=None)
    assert end.outcome is Outcome.UNCLEAR
    assert end.after


def test_the_policys_own_word_counts_where_the_caller_says_so() -> None:
    cell = FakeCell(script=lambda cell, t: {"policy_done": bool(cell.began) and t > 1})
    assert run(cell, until={"kind": "policy_done"}).outcome is Outcome.SUCCEEDED


@pytest.mark.parametrize("when", [0.0, 1.0])
def test_a_cancelled_task_is_stopped_and_nothing_moves(when: float) -> None:
    def on_wait(cell: FakeCell) -> None:
        cell.halted = cell.time_s >= when

    cell = FakeCell(script=lambda cell, t: lift(0.0), on_wait=on_wait)
    end = run(cell)
    assert end.outcome is Outcome.STOPPED
    assert not cell.moving


def test_a_policy_that_somebody_took_away_stops_the_task() -> None:
    def script(cell: FakeCell, t: float) -> dict[str, object]:
        cell.taken = "the emergency stop is latched" if t > 1 else ""
        return lift(0.0)

    end = run(FakeCell(script=script))
    assert end.outcome is Outcome.STOPPED
    assert "emergency stop" in end.reason


def test_a_first_attempt_that_cannot_begin_is_an_error() -> None:
    with pytest.raises(NotReadyError):
        run(FakeCell(refuses=1, script=lambda cell, t: lift(0.0)))


def test_a_later_one_stops_the_task() -> None:
    cell = FakeCell(refuses=2, script=lambda cell, t: lift(0.0))
    assert run(cell).outcome is Outcome.STOPPED


def test_a_fault_in_judging_leaves_no_motion() -> None:
    def script(cell: FakeCell, t: float) -> dict[str, object]:
        if cell.began and t > 1:
            raise RuntimeError("a detector broke")
        return lift(0.0)

    cell = FakeCell(script=script)
    with pytest.raises(RuntimeError):
        run(cell)
    assert not cell.moving


def test_a_policy_that_refuses_has_failed_with_its_reason_and_is_not_asked_again() -> None:
    def script(cell: FakeCell, t: float) -> dict[str, object]:
        cell.failure = "the instruction names 2 objects" if cell.began else ""
        return {"joints": None}  # nothing can be judged either

    cell = FakeCell(script=script, acts=False)
    end = run(cell)
    assert (end.outcome, end.attempts) == (Outcome.FAILED, 1)
    assert "the policy refuses: the instruction names 2 objects" in end.reason


def test_a_module_that_dies_ends_the_task_at_the_next_look_with_its_name() -> None:
    def script(cell: FakeCell, t: float) -> dict[str, object]:
        cell.taken = "control has ended by itself (signal 9)" if cell.began and t > 1 else ""
        return {"joints": None}

    end = run(FakeCell(script=script))
    assert (end.outcome, end.reason) == (Outcome.STOPPED, "control has ended by itself (signal 9)")
    assert end.took_s == pytest.approx(1.0, abs=0.2)


def test_a_task_that_is_ended_says_by_whom() -> None:
    def on_wait(cell: FakeCell) -> None:
        cell.halted = cell.time_s >= 1.0
        cell.taken = "perception was stopped" if cell.halted else ""

    assert (
        run(FakeCell(script=lambda cell, t: lift(0.0), on_wait=on_wait)).reason
        == "perception was stopped"
    )


HELD = {"kind": "held", "for_s": 1.0, "of": LIFTED}


def test_what_has_to_last_is_looked_at_for_so_long_before_anything_moves() -> None:
    cell = FakeCell(script=lambda cell, t: lift(0.2))
    end = run(cell, until=HELD)
    assert (end.outcome, end.attempts, cell.began) == (Outcome.SUCCEEDED, 0, 0)
    assert end.took_s == pytest.approx(1.0, abs=0.15)


def test_what_is_not_so_costs_no_time_before_the_first_attempt() -> None:
    cell = FakeCell(script=lambda cell, t: lift(0.2 if cell.began and t > 1 else 0.0))
    assert run(cell, until=HELD).outcome is Outcome.SUCCEEDED
    assert cell.looks[1].now_s == pytest.approx(0.0)


def test_one_look_that_cannot_tell_while_the_arm_comes_to_rest_hides_no_success() -> None:
    flickers = []

    def script(cell: FakeCell, t: float) -> dict[str, object]:
        if cell.ended_s is not None and cell.time_s > cell.ended_s + 1.2 and not flickers:
            flickers.append(t)
            return {"joints": None}
        return lift(0.2 if cell.began and t > 1 else 0.0) | {
            "still_s": 0.0 if not flickers else 1.0
        }

    end = run(FakeCell(script=script), until=HELD)
    assert flickers
    assert end.outcome is Outcome.SUCCEEDED
