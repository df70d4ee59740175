"""A model that answers with nonsense, or a connection that takes no answer, affects only its own
robot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from policy_servers import SEEN, Robot, answers

from rn_backend_openpi.batching import Answer, Batcher, Waiting
from rn_backend_openpi.model import SharedModel
from rn_testing.waiting import wait_until
from roboneuron import ActionChunk, NotReadyError, Observation, PluginError

CHUNK = ActionChunk(actions=np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]]), step_s=0.1)
BOUND_S = 20.0
pytestmark = pytest.mark.timeout(200)


class Asked:
    """A batcher with a model that answers each instruction as told."""

    def __init__(self, model: dict[str, object]) -> None:
        self._model = model
        self.answers: dict[str, Answer] = {}
        self.batcher = Batcher(self._predict, most=4, waiting=2, clock=lambda: self.now_s)
        self.now_s = 100.0

    def _predict(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        answers = (self._model.get(one.instruction, CHUNK) for one in observations)
        return list(answers)  # type: ignore[arg-type]

    def ask(self, name: str, connection: object = None, within_s: float = 10.0) -> None:
        """Queue an observation whose answer is kept; that of a broken connection raises."""

        def tell(answer: Answer) -> None:
            if "broken" in name:
                raise KeyError(name)
            self.answers[name] = answer

        seen = Observation(frames={}, instruction=name)
        deadline_s = self.now_s + within_s
        self.batcher.submit(
            Waiting(observation=seen, deadline_s=deadline_s, tell=tell, connection=connection)
        )


@pytest.fixture
def asked() -> Iterator[Callable[[dict[str, object]], Asked]]:
    """Return a function that makes a batcher, closed with the test."""
    made: list[Asked] = []

    def make(model: dict[str, object]) -> Asked:
        made.append(Asked(model))
        return made[-1]

    yield make
    for one in made:
        one.batcher.close()


@pytest.mark.parametrize(
    ("wrong", "told"),
    [(None, "NoneType"), ({"actions": [[0.0]]}, "dict"), (CHUNK.actions, "ndarray")],
)
def test_another_type_than_a_chunk_is_an_error_of_that_robot_only(
    asked: Callable[..., Asked], wrong: object, told: str
) -> None:
    one = asked({"bad": wrong})
    one.batcher.start()
    one.ask("bad")
    one.ask("good")
    wait_until(lambda: {"bad", "good"} <= one.answers.keys(), BOUND_S, "both are answered")
    error = one.answers["bad"]
    assert isinstance(error, PluginError)
    assert f"returned {told} for an observation, expected an ActionChunk" in error.message
    assert isinstance(one.answers["good"], ActionChunk)
    one.ask("next")
    wait_until(lambda: "next" in one.answers, BOUND_S, "the next one is answered")


def test_a_model_that_exits_is_told_and_asked_again() -> None:
    told: list[Answer] = []

    def predict(_: Sequence[Observation]) -> Sequence[Answer]:
        if not told:
            raise SystemExit(2)
        return [CHUNK]

    batcher = Batcher(predict, most=1, waiting=1)
    batcher.start()
    for count in (1, 2):
        seen = Observation(frames={}, instruction="go")
        batcher.submit(Waiting(observation=seen, deadline_s=float("inf"), tell=told.append))
        wait_until(lambda: len(told) == count, BOUND_S, "it is answered")  # noqa: B023
    batcher.close()
    assert [type(answer) for answer in told] == [PluginError, ActionChunk]


def test_a_connection_that_takes_no_answer_ends_nothing(
    asked: Callable[..., Asked], caplog: pytest.LogCaptureFixture
) -> None:
    one = asked({})
    one.ask("broken")
    one.ask("good")
    one.batcher.start()
    wait_until(lambda: "good" in one.answers, BOUND_S, "the other one is answered")
    one.ask("next")
    wait_until(lambda: "next" in one.answers, BOUND_S, "the next one is answered")
    assert "An answer could not be passed on" in caplog.text


def test_a_connection_that_takes_no_refusal_ends_nothing(asked: Callable[..., Asked]) -> None:
    one = asked({})
    one.ask("broken late", within_s=1.0)
    one.now_s += 2.0
    one.ask("good")
    one.batcher.step()
    assert isinstance(one.answers["good"], ActionChunk)
    one.ask("broken replaced", connection=one)
    one.ask("newer", connection=one)
    one.batcher.step()
    assert isinstance(one.answers["newer"], ActionChunk)
    one.ask("broken closed")
    one.ask("closed")
    one.batcher.close()
    assert isinstance(one.answers["closed"], NotReadyError)


def nonsense(name: str) -> object:
    """What the model of these tests answers to an instruction."""
    if name == "nothing":
        return None
    return replace(CHUNK, metrics={"unsendable": 10**400})


@pytest.mark.parametrize(
    ("name", "told"), [("nothing", "returned NoneType"), ("unsendable", "cannot be sent")]
)
def test_a_server_goes_on_after_nonsense_of_its_model(
    served: Robot, monkeypatch: pytest.MonkeyPatch, name: str, told: str
) -> None:
    alone = SharedModel._alone

    def answer(model: SharedModel, observation: Observation) -> object:
        if observation.instruction == name:
            return nonsense(name)
        return alone(model, observation)

    monkeypatch.setattr(SharedModel, "_alone", answer)
    one, other = served(), served()
    with pytest.raises(PluginError, match=told):
        one.predict(replace(SEEN, instruction=name))
    assert answers(one)
    assert answers(other)
