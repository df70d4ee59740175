"""Batches, order and refusals of the batcher, with a controlled clock."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import pytest

from rn_backend_openpi.batching import Answer, Batcher, Waiting
from roboneuron import ActionChunk, NotReadyError, Observation, PluginError, UngroundedError

ROW = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]])


class Model:
    """Takes a fixed time plus a little for each observation; stores the batches."""

    def __init__(self, took_s: float = 0.1, each_s: float = 0.0, **options: int) -> None:
        self.now_s = 100.0
        self.took_s, self.each_s = took_s, each_s
        self.batches: list[list[str]] = []
        self.answers: dict[str, Answer] = {}
        self.fails: Exception | None = None
        self.batcher = Batcher(
            self.predict, **{"most": 4, "waiting": 8, **options}, clock=lambda: self.now_s
        )

    def predict(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        self.batches.append([observation.instruction for observation in observations])
        self.now_s += self.took_s + self.each_s * len(observations)
        if self.fails is not None:
            raise self.fails
        return [ActionChunk(actions=ROW, step_s=0.1, metrics={"own": 1.0}) for _ in observations]

    def ask(self, name: str, within_s: float = 10.0, connection: object = None) -> None:
        seen = Observation(frames={}, instruction=name)
        tell = lambda answer: self.answers.__setitem__(name, answer)  # noqa: E731
        self.batcher.submit(
            Waiting(
                observation=seen,
                deadline_s=self.now_s + within_s,
                tell=tell,
                connection=connection,
            )
        )


def test_what_waits_is_answered_together_in_the_order_in_which_it_came() -> None:
    model = Model()
    for name, within_s in (("d", 5.0), ("b", 3.0), ("e", 6.0), ("a", 2.0), ("c", 4.0)):
        model.ask(name, within_s)
    model.batcher.step()
    model.batcher.step()
    assert model.batches == [["d", "b", "e", "a"], ["c"]]
    chunk = model.answers["a"]
    assert isinstance(chunk, ActionChunk)
    assert chunk.metrics == {
        "own": 1.0,
        "shared.batch": 4.0,
        "shared.queue_ms": 0.0,
        "shared.model_ms": pytest.approx(100.0),
    }


def test_a_batch_is_no_larger_than_its_first_deadline_allows() -> None:
    model = Model(took_s=0.1, each_s=0.1)
    for count in (1, 2, 3, 4):  # 0.2, 0.3, 0.4, 0.5 s
        for index in range(count):
            model.ask(f"{count}.{index}")
        model.batcher.step()
    for name in "abcd":
        model.ask(name, within_s=0.35)
    model.batcher.step()
    assert model.batches[-1] == ["a", "b"]


def test_one_hiccup_does_not_bar_large_batches_for_good() -> None:
    model = Model(took_s=5.0)
    for name in "abcd":
        model.ask(name)
    model.batcher.step()
    model.took_s = 0.1
    for _ in range(40):
        for name in "abcd":
            model.ask(name, within_s=0.5)
        while model.batcher.take() != ([], []):
            pass
    for name in "abcd":
        model.ask(name, within_s=0.5)
    model.batcher.step()
    assert len(model.batches[-1]) == 4


def test_what_is_too_late_is_refused_and_never_shown_to_the_model() -> None:
    model = Model()
    model.ask("late", within_s=1.0)
    model.now_s += 2.0
    model.ask("good")
    model.batcher.step()
    assert model.batches == [["good"]]
    assert isinstance(model.answers["late"], NotReadyError)
    assert isinstance(model.answers["good"], ActionChunk)


def test_the_queue_is_bounded() -> None:
    model = Model(waiting=2)
    model.ask("a")
    model.ask("b")
    with pytest.raises(NotReadyError, match="2 observations waiting"):
        model.ask("c")
    model.batcher.close()
    assert isinstance(model.answers["b"], NotReadyError)
    with pytest.raises(NotReadyError):
        model.ask("d")


def test_a_robot_has_one_place_in_the_queue() -> None:
    model = Model(most=1, waiting=3)
    for number in range(20):
        model.ask(f"greedy {number}", connection="greedy")
    model.ask("a", connection="one")
    model.ask("b", connection="other")
    for number in range(3):
        model.batcher.step()
        model.ask(f"again {number}", connection="greedy")
    assert model.batches == [["greedy 19"], ["a"], ["b"]]
    assert isinstance(model.answers["greedy 18"], NotReadyError)
    assert isinstance(model.answers["again 1"], NotReadyError)


def test_one_hasty_robot_shrinks_no_batch_but_its_own() -> None:
    model = Model(took_s=0.1, each_s=0.1)
    for name in "abc":
        model.ask(name)
    model.batcher.step()  # 0.4 s
    model.ask("hasty", within_s=0.3)
    model.ask("hastier", within_s=0.35)
    model.ask("patient")
    model.batcher.step()
    model.batcher.step()
    assert model.batches[1:] == [["hasty", "hastier"], ["patient"]]


@pytest.mark.parametrize(
    ("error", "kind"),
    [(UngroundedError("no cube"), UngroundedError), (KeyError("weights"), PluginError)],
)
def test_a_batch_that_fails_is_told_to_everybody_in_it(
    error: Exception, kind: type[Exception]
) -> None:
    model = Model()
    model.fails = error
    model.ask("a")
    model.ask("b")
    model.batcher.step()
    assert {name: type(answer) for name, answer in model.answers.items()} == {"a": kind, "b": kind}
    model.fails = None
    model.ask("c")
    model.batcher.step()
    assert isinstance(model.answers["c"], ActionChunk)


def test_the_thread_answers_until_it_is_closed() -> None:
    answered = threading.Event()
    batcher = Batcher(
        lambda observations: [ActionChunk(actions=ROW, step_s=0.1) for _ in observations],
        most=4,
        waiting=4,
    )
    batcher.start()
    seen = Observation(frames={}, instruction="go")
    batcher.submit(
        Waiting(observation=seen, deadline_s=float("inf"), tell=lambda answer: answered.set())
    )
    assert answered.wait(30.0)
    batcher.close()
    batcher.close()
