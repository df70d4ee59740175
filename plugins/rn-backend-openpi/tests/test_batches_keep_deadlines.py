"""Batches, order and refusals of the batcher, with a controlled clock; a model that answers with
nonsense, or a connection that takes no answer, affects only its own robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from policy_servers import SEEN, Robot, answers

from rn_backend_openpi.batching import Answer, Batcher, Waiting
from rn_backend_openpi.model import SharedModel
from rn_testing.waiting import wait_until
from roboneuron import ActionChunk, NotReadyError, Observation, PluginError, UngroundedError

CHUNK = ActionChunk(actions=np.array([[0.0] * 6 + [0.5]]), step_s=0.1, metrics={"own": 1.0})


class Model:
    """Takes a fixed time plus a little for each observation; stores the batches, and the answer to
    each instruction. Connections whose name begins with "broken" take no answer.

    Attributes:
        says: answers by instruction; a chunk for others.
        fails: raised by the next predictions.
    """

    def __init__(self, took_s: float = 0.1, each_s: float = 0.0, **options: int) -> None:
        self.now_s = 100.0
        self.took_s, self.each_s = took_s, each_s
        self.batches: list[list[str]] = []
        self.answers: dict[str, Answer] = {}
        self.says: dict[str, Any] = {}
        self.fails: BaseException | None = None
        self.batcher = Batcher(
            self.predict, **{"most": 4, "waiting": 8, **options}, clock=lambda: self.now_s
        )

    def predict(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        self.batches.append([observation.instruction for observation in observations])
        self.now_s += self.took_s + self.each_s * len(observations)
        if self.fails is not None:
            raise self.fails
        return [self.says.get(one.instruction, CHUNK) for one in observations]

    def ask(self, *names: str, within_s: float = 10.0, connection: object = None) -> None:
        for name in names:
            self.batcher.submit(
                Waiting(
                    observation=Observation(frames={}, instruction=name),
                    deadline_s=self.now_s + within_s,
                    tell=lambda answer, name=name: self._tell(name, answer),
                    connection=connection,
                )
            )

    def _tell(self, name: str, answer: Answer) -> None:
        if name.startswith("broken"):
            raise KeyError(name)
        self.answers[name] = answer

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.batcher.step()

    def kinds(self, *names: str) -> list[type]:
        return [type(self.answers[name]) for name in names]


def test_what_waits_is_answered_together_in_the_order_in_which_it_came() -> None:
    model = Model()
    for name, within_s in (("d", 5.0), ("b", 3.0), ("e", 6.0), ("a", 2.0), ("c", 4.0)):
        model.ask(name, within_s=within_s)
    model.step(2)
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
    for names in ("a", "ab", "abc", "abcd"):  # 0.2, 0.3, 0.4, 0.5 s
        model.ask(*names)
        model.step()
    model.ask(*"efgh", within_s=0.35)
    model.step()
    assert model.batches[-1] == ["e", "f"]


def test_one_hiccup_does_not_bar_large_batches_for_good() -> None:
    model = Model(took_s=5.0)
    model.ask(*"abcd")
    model.step()
    model.took_s = 0.1
    for _ in range(40):
        model.ask(*"abcd", within_s=0.5)
        while model.batcher.take() != ([], []):
            pass
    model.ask(*"abcd", within_s=0.5)
    model.step()
    assert len(model.batches[-1]) == 4


def test_one_hasty_robot_shrinks_no_batch_but_its_own() -> None:
    model = Model(took_s=0.1, each_s=0.1)
    model.ask(*"abc")
    model.step()  # 0.4 s
    model.ask("hasty", within_s=0.3)
    model.ask("hastier", within_s=0.35)
    model.ask("patient")
    model.step(2)
    assert model.batches[1:] == [["hasty", "hastier"], ["patient"]]


def test_what_is_too_late_is_refused_and_never_shown_to_the_model() -> None:
    model = Model()
    model.ask("late", "broken late", within_s=1.0)
    model.now_s += 2.0
    model.ask("good")
    model.step()
    assert model.batches == [["good"]]
    assert model.kinds("late", "good") == [NotReadyError, ActionChunk]


def test_the_queue_is_bounded() -> None:
    model = Model(waiting=2)
    model.ask("broken", "b")
    with pytest.raises(NotReadyError, match="2 observations waiting"):
        model.ask("c")
    model.batcher.close()
    assert model.kinds("b") == [NotReadyError]
    with pytest.raises(NotReadyError):
        model.ask("d")


def test_a_robot_has_one_place_in_the_queue() -> None:
    model = Model(most=1, waiting=3)
    model.ask("broken", *(f"greedy {number}" for number in range(20)), connection="greedy")
    model.ask("a", connection="one")
    model.ask("b", connection="other")
    for number in range(3):
        model.step()
        model.ask(f"again {number}", connection="greedy")
    assert model.batches == [["greedy 19"], ["a"], ["b"]]
    assert model.kinds("greedy 18", "again 1") == [NotReadyError, NotReadyError]


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (UngroundedError("no cube"), UngroundedError),
        (KeyError("weights"), PluginError),
        (SystemExit(2), PluginError),
    ],
)
def test_a_batch_that_fails_is_told_to_everybody_in_it(
    error: BaseException, kind: type[Exception]
) -> None:
    model = Model()
    model.fails = error
    model.ask("a", "b")
    model.step()
    model.fails = None
    model.ask("c")
    model.step()
    assert model.kinds("a", "b", "c") == [kind, kind, ActionChunk]


@pytest.fixture
def running() -> Iterator[Model]:
    """A model whose batcher runs on its thread."""
    model = Model()
    model.batcher.start()
    yield model
    model.batcher.close()
    model.batcher.close()


@pytest.mark.parametrize("wrong", [None, {"actions": [[0.0]]}, CHUNK.actions])
def test_another_type_than_a_chunk_is_an_error_of_that_robot_only(
    running: Model, wrong: object, caplog: pytest.LogCaptureFixture
) -> None:
    running.says["bad"] = wrong
    running.ask("broken", "bad", "good")
    wait_until(lambda: {"bad", "good"} <= running.answers.keys(), 20.0, "both are answered")
    assert running.kinds("bad", "good") == [PluginError, ActionChunk]
    assert f"returned {type(wrong).__name__} for an obs" in str(running.answers["bad"])
    assert "An answer could not be passed on" in caplog.text
    running.ask("next")
    wait_until(lambda: "next" in running.answers, 20.0, "the next one is answered")


@pytest.mark.timeout(200)
def test_a_server_goes_on_after_nonsense_of_its_model(
    served: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    nonsense = {"nothing": None, "unsendable": replace(CHUNK, metrics={"large": 10**400})}
    alone = SharedModel._alone

    def answer(model: SharedModel, observation: Observation) -> object:
        if observation.instruction in nonsense:
            return nonsense[observation.instruction]
        return alone(model, observation)

    monkeypatch.setattr(SharedModel, "_alone", answer)
    one, other = served(), served()
    for name, told in (("nothing", "returned NoneType"), ("unsendable", "cannot be sent")):
        with pytest.raises(PluginError, match=told):
            one.predict(replace(SEEN, instruction=name))
        assert answers(one)
        assert answers(other)
