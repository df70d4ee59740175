"""A second policy takes over when the first is late, and gives back when it is in time again.

Time passes when the waiting thread says so: each look at an answer that is not there takes a
second.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from fallback_pair import AGREED, FIRST, HOLD_AFTER_S, PERIOD_S, SECOND, Clock, Pair

from roboneuron import (
    Channel,
    ControlSpace,
    InvalidInputError,
    NotReadyError,
    Observation,
    PlanningError,
)
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.mode import Abilities
from roboneuron.modules.inference import fallback
from roboneuron.modules.inference.agreement import SpaceAgreement, check_same_space
from roboneuron.modules.inference.execution import FALLBACK, Bounds, ChunkExecutor
from roboneuron.modules.inference.fallback import BACK_ANSWERS, BACK_S
from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.predictions import SEQUENTIAL, PredictionRequest
from roboneuron.modules.step_filters import StepFilter, StepFilters


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(fallback, "time", made)
    return made


@pytest.fixture
def pair(clock: Clock) -> Iterator[Pair]:
    made = Pair(clock, ChunkExecutor(Bounds(first_s=0.5)))
    yield made
    made.first.may_answer.set()
    assert made.policies.close()


def lose(pair: Pair) -> None:
    """Let the first policy act once, then fall silent; the second has taken over."""
    assert pair.whose() == FIRST
    pair.first.may_answer.clear()
    assert pair.ask() is None
    assert pair.values["fallback.acting"] == "local"


def test_the_first_acts_as_long_as_it_answers(pair: Pair) -> None:
    assert [pair.whose() for _ in range(20)] == [FIRST] * 20
    assert pair.values["fallback.acting"] == "remote"
    assert not pair.second.asked


def test_the_second_is_asked_about_the_next_image_when_the_first_is_late(pair: Pair) -> None:
    lose(pair)
    found = pair.ask()
    assert found is not None
    prediction, chunk = found
    assert prediction.mode == FALLBACK
    assert chunk.actions[0, 0] == SECOND
    assert chunk.note.startswith("local acts in place of remote: no answer within ")
    assert pair.second.asked[-1].stamp_ns == int(pair.clock.now_s * 1e9)
    assert pair.values["fallback.count"] == 1


def test_an_answer_that_comes_after_the_turn_has_changed_moves_nothing(pair: Pair) -> None:
    lose(pair)
    assert pair.whose() == SECOND
    pair.first.may_answer.set()
    pair.settle()
    assert [pair.whose() for _ in range(3)] == [SECOND] * 3


def test_the_first_has_until_its_rows_have_ended_and_a_share_of_the_time_to_hold(
    pair: Pair, clock: Clock
) -> None:
    found = pair.ask()
    assert found is not None
    prediction, chunk = found
    pair.executor.answer(prediction, chunk, int(clock.now_s * 1e9))
    due_s = pair.executor.end_s()
    assert due_s is not None
    pair.executor._due_s = clock.now_s + 10.0  # a long motion is under way
    looks = 0

    def wait() -> None:
        nonlocal looks
        looks += 1
        clock.now_s += 1.0

    pair.policies.on_wait = wait
    pair.first.may_answer.clear()
    assert pair.ask() is None
    assert looks == 11, "its last row is due after 10.15 s"
    assert pair.policies._slack_s() == pytest.approx(HOLD_AFTER_S - PERIOD_S - 0.05)


def test_what_holds_soon_leaves_the_first_a_share_of_that_time(pair: Pair) -> None:
    pair.policies._hold_after_s = 0.04
    assert pair.policies._slack_s() == pytest.approx(0.01)


def test_the_first_answer_to_an_instruction_is_waited_for(pair: Pair, clock: Clock) -> None:
    pair.first.may_answer.clear()
    before_s = clock.now_s
    assert pair.ask() is None
    assert clock.now_s - before_s >= fallback.FIRST_S


def test_the_first_acts_again_when_it_has_answered_in_time_for_a_while(
    pair: Pair, clock: Clock
) -> None:
    lose(pair)
    pair.first.may_answer.set()
    pair.settle()  # what was late does not count
    began_s, given_back = clock.now_s, None
    for _ in range(60):
        found = pair.ask()
        assert found is not None
        if found[1].actions[0, 0] == FIRST:
            given_back = found[0]
            break
        pair.settle()
    assert given_back is not None
    assert BACK_S <= clock.now_s - began_s < BACK_S + 5 * PERIOD_S
    assert given_back.mode == SEQUENTIAL
    assert int(clock.now_s * 1e9) - given_back.captured_ns <= 2 * PERIOD_S * 1e9
    assert pair.values["fallback.acting"] == "remote"
    assert pair.values["fallback.reason"] == ""
    assert pair.whose() == FIRST
    assert [event for event, _ in pair.events] == ["fallback", "fallback_over"]
    assert pair.events[0][1].startswith("local acts: no answer within ")
    assert pair.values["fallback.count"] == 1


def test_one_late_answer_begins_the_while_anew(pair: Pair, clock: Clock) -> None:
    lose(pair)
    pair.first.may_answer.set()
    pair.settle()
    for _ in range(25):
        assert pair.whose() == SECOND
        pair.settle()
    pair.first.may_answer.clear()
    assert pair.whose() == SECOND
    clock.now_s += 1.0
    pair.first.may_answer.set()
    pair.settle()
    for _ in range(25):
        assert pair.whose() == SECOND
        pair.settle()


def test_few_answers_are_not_enough(pair: Pair, clock: Clock) -> None:
    lose(pair)
    pair.first.may_answer.set()
    pair.settle()
    for _ in range(BACK_ANSWERS):
        assert pair.whose() == SECOND
        pair.settle()
        clock.now_s += BACK_S
    assert pair.whose() == FIRST


def test_a_policy_that_is_gone_is_replaced_at_once_and_quoted(pair: Pair, clock: Clock) -> None:
    assert pair.whose() == FIRST
    pair.first.error = NotReadyError("The server of the model is gone.")
    before_s = clock.now_s
    assert pair.ask() is None
    assert clock.now_s - before_s == pytest.approx(PERIOD_S)
    assert pair.values["fallback.reason"] == "The server of the model is gone."
    assert pair.whose() == SECOND


def test_what_the_first_says_against_the_image_is_not_hidden_by_the_second(pair: Pair) -> None:
    pair.first.error = InvalidInputError("The image is black.")
    with pytest.raises(InvalidInputError, match="black"):
        pair.ask()
    assert not pair.second.asked


def test_what_the_second_says_against_the_image_is_told(pair: Pair) -> None:
    lose(pair)
    pair.second.error = NotReadyError("There is no cube.")
    with pytest.raises(NotReadyError, match="no cube"):
        pair.ask()


def test_a_wait_ends_with_the_module(pair: Pair) -> None:
    pair.first.may_answer.clear()
    pair.policies.on_wait = pair.stop.set
    assert pair.ask() is None
    assert pair.values["fallback.acting"] == "remote"


def test_a_new_instruction_resets_both_once(pair: Pair) -> None:
    assert pair.whose() == FIRST
    assert pair.whose() == FIRST
    assert (pair.first.resets, pair.second.resets) == (1, 1)
    pair.is_new = True
    pair.first.may_answer.clear()
    assert pair.ask() is None
    pair.is_new = True
    assert pair.whose() == SECOND
    assert pair.second.resets == 3
    pair.first.may_answer.set()
    pair.settle()
    assert pair.whose() == SECOND
    pair.settle()
    assert pair.first.resets == 3, "before its next answer"


def test_each_policy_gets_the_images_of_its_own_cameras(clock: Clock) -> None:
    pair = Pair(clock, ChunkExecutor(Bounds(first_s=0.5)), "wrist")
    lose(pair)
    pair.ask()
    assert set(pair.first.asked[0].frames) == {"primary", "wrist"}
    assert set(pair.second.asked[0].frames) == {"primary"}
    pair.first.may_answer.set()
    assert pair.policies.close()


def test_answers_of_the_second_follow_each_other_and_say_nothing_of_the_firsts_latency(
    clock: Clock,
) -> None:
    executor = AdaptiveExecutor(Abilities(), fixed="overlap", bounds=Bounds(first_s=0.5))
    pair = Pair(clock, executor)
    found = pair.ask()
    assert found is not None
    assert executor.answer(*found, int(clock.now_s * 1e9) + 200_000_000) == "accepted"
    told = executor.status()
    assert executor.wants_prediction(0.0), "chunks overlap"
    pair.first.may_answer.clear()
    executor.drop()
    assert pair.ask() is None
    for _ in range(3):
        executor.drop()
        found = pair.ask()
        assert found is not None
        assert executor.answer(*found, int(clock.now_s * 1e9)) == "accepted"
        assert not executor.wants_prediction(0.0), "until its rows have been sent"
    assert executor.status().latency_p99_ms == told.latency_p99_ms
    pair.first.may_answer.set()
    assert pair.policies.close()


def test_the_first_is_not_told_of_rows_of_the_second(clock: Clock) -> None:
    executor = AdaptiveExecutor(
        Abilities(conditions_on_rows=True), fixed="rtc", bounds=Bounds(first_s=0.5)
    )
    pair = Pair(clock, executor)
    lose(pair)
    pair.first.may_answer.set()
    pair.settle()
    for _ in range(60):
        found = pair.ask()
        assert found is not None
        executor.answer(*found, int(clock.now_s * 1e9))
        if found[1].actions[0, 0] == FIRST:
            break
        pair.settle()
    assert found[0].mode == "overlap"
    assert pair.first.asked[-1].ahead is None
    assert pair.policies.close()


def test_two_policies_of_different_spaces_take_no_turns() -> None:
    space = ControlSpace(
        kind="joint_position", channels=(Channel(name="a", unit="rad"),), rate_hz=20.0
    )
    other = SpaceAgreement(declared=space, executed=space, columns=(0,))
    check_same_space(AGREED, AGREED, "local")
    with pytest.raises(PlanningError, match="The fallback 'local' yields joint_position"):
        check_same_space(AGREED, other, "local")


def test_both_policies_are_told_the_instruction() -> None:
    asked: dict[str, Observation] = {}

    class Both(StepFilter):
        def predict(self, request: PredictionRequest, proceed: Any) -> None:
            asked.update(first=request.prediction.observation, second=request.measured)

    seen = Observation(
        frames={}, instruction="", joints=None, ee_pose=None, gripper_open=None, stamp_ns=5
    )
    executor = ChunkExecutor(Bounds(first_s=1.0))
    module = SimpleNamespace(
        filters=StepFilters([Both()]),
        executor=executor,
        node=SimpleNamespace(stopped=False),
        _inputs=SimpleNamespace(captured_ns=lambda observation: 5),
        _not_before_ns=0,
        _instruction=SimpleNamespace(count=1, text="pick up the red cube", is_new=True),
        _observe=lambda: seen,
    )
    module._predict = partial(InferenceModule._predict, module)
    module._ask_policy = None
    executor.begin_epoch()
    InferenceModule._step(module, threading.Event())  # type: ignore[arg-type]
    assert asked["first"].instruction == "pick up the red cube"
    assert asked["second"].instruction == "pick up the red cube"
