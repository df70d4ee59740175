"""A monitor behind its guard: slow, failing and nonsensical answers make it absent."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import pytest
from monitors import BOUND_S, Scripted, observation, settled

from rn_standard.tasks.guarded import AskedMonitor, GuardedMonitor
from rn_standard.tasks.monitor import Score

DONE = Score(value=0.95, reason="the cube is up", progress=1.0)


class Clock:
    """Monotonic time that a test sets."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def guarded(
    told: Callable[..., object], clock: Callable[[], float] | None = None
) -> GuardedMonitor:
    return GuardedMonitor(lambda: Scripted(told), 2.0, clock or Clock())


def asked(guard: GuardedMonitor) -> str:
    guard.reset(observation())
    assert guard.offer(observation(), 0.0)
    answer = settled(guard)
    guard.close()
    assert answer.score is None
    return answer.reason


def test_a_good_answer_counts_until_it_is_old() -> None:
    clock = Clock()
    guard = guarded(lambda seen: DONE, clock)
    guard.reset(observation())
    assert guard.answer().score is None
    guard.offer(observation(), 0.0)
    assert settled(guard).score == DONE
    clock.now_s = 3.5
    assert "3.5 s old" in guard.answer().reason
    assert guard.answer().score is None
    guard.close()


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (Score(value=math.nan, reason="x"), "its value is nan"),
        (Score(value=1.5, reason="x"), "its value is 1.5"),
        (Score(value=0.5, reason="x", progress=math.inf), "its progress is inf"),
        (Score(value=0.5, reason="x", failure=-0.1), "its failure is -0.1"),
        (Score(value="1", reason="x"), "its value is 1,"),  # type: ignore[arg-type]
        (Score(value=0.5, reason=""), "no reason"),
        (0.5, "float, expected a Score"),
        (None, "NoneType, expected a Score"),
    ],
)
def test_nonsense_is_no_answer(answer: object, text: str) -> None:
    assert text in asked(guarded(lambda seen: answer))


def test_an_exception_is_a_reason() -> None:
    def fail(seen: object) -> Score:
        raise RuntimeError("the weights are gone")

    assert asked(guarded(fail)) == "it has failed: RuntimeError: the weights are gone"


def test_a_monitor_that_cannot_be_built_is_absent() -> None:
    def build() -> Scripted:
        raise ImportError("torch")

    assert "ImportError: torch" in asked(GuardedMonitor(build, 2.0))


def test_a_late_answer_does_not_count() -> None:
    clock = Clock()

    def slow(seen: object) -> Score:
        clock.now_s += 3.0
        return DONE

    assert "took 3.0 s (its limit is 2 s)" in asked(guarded(slow, clock))


def test_a_hanging_monitor_never_holds_the_caller() -> None:
    clock, hangs = Clock(), threading.Event()
    entered = threading.Event()

    def hang(seen: object) -> Score:
        entered.set()
        hangs.wait(BOUND_S)
        return DONE

    guard = guarded(hang, clock)
    guard.reset(observation())
    guard.offer(observation(), 0.0)
    assert entered.wait(BOUND_S)
    assert not guard.offer(observation(), 0.0), "nothing is queued behind it"
    clock.now_s = 5.0
    assert "has not answered for 5.0 s (its limit is 2 s)" in guard.answer().reason
    assert guard.is_busy
    hangs.set()
    assert settled(guard).score is None, "what comes after the limit is dropped"
    guard.close()


def test_an_answer_of_the_attempt_before_does_not_count() -> None:
    entered, go_on = threading.Event(), threading.Event()

    def late(seen: object) -> Score:
        entered.set()
        go_on.wait(BOUND_S)
        return DONE

    guard = guarded(late)
    guard.reset(observation())
    guard.offer(observation(), 0.0)
    assert entered.wait(BOUND_S)
    guard.reset(observation())
    go_on.set()
    assert settled(guard).score is None
    guard.close()


def test_a_slow_monitor_as_a_predicate_answers_at_once() -> None:
    entered, go_on = threading.Event(), threading.Event()

    def late(seen: object) -> Score:
        entered.set()
        go_on.wait(BOUND_S)
        return DONE

    monitor = AskedMonitor(lambda: Scripted(late), 2.0)
    monitor.reset(observation())
    assert monitor.score(observation()).value is None
    assert entered.wait(BOUND_S)
    go_on.set()
    waiting = threading.Event()
    for _ in range(2000):
        if monitor.score(observation()) == DONE:
            return
        waiting.wait(0.005)
    pytest.fail("its answer never came")
