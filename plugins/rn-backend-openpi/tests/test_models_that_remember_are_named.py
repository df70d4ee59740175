"""A model with a history of observations cannot be given one twice; the error says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rn_backend_openpi.coding import Coder
from rn_backend_openpi.messages import Document, to_observation
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import SHARED
from rn_backend_servo.case import contract_case
from rn_testing.fakes.backend import make_observation
from roboneuron import (
    ActionChunk,
    ConfigurationError,
    NotReadyError,
    RoboNeuronError,
    UngroundedError,
)

SEEN = make_observation(SHARED)


class Far:
    """A server whose model answers only some of the requests."""

    def __init__(self, *answers: RoboNeuronError | None) -> None:
        self.answers = list(answers)

    def ask(self, document: Document, deadline_s: float) -> ActionChunk:
        answer = self.answers.pop(0) if self.answers else None
        if answer is not None:
            raise answer
        rows = np.full((2, 7), 0.01)
        return ActionChunk(actions=rows, step_s=0.1, metrics={"shared.link_ms": 1.0})


def coder(coding: str = "auto") -> Coder:
    return Coder(PolicyOptions.model_validate({"address": "gpu:1", "coding": coding}), {}, 0.001)


@pytest.mark.parametrize("place", [1, 2])
@pytest.mark.parametrize("coding", ["auto", "jpeg"])
def test_a_model_that_refuses_what_it_has_seen_is_said_to_remember(place: int, coding: str) -> None:
    far = Far(*[None] * place, UngroundedError("The image has not changed."))
    with pytest.raises(ConfigurationError) as caught:
        coder(coding).ask(SEEN, far.ask, float("inf"))
    assert "keeps a history of observations" in caught.value.message
    assert "The image has not changed." in caught.value.message
    for word in ("stateless = true", "coding = 'raw'"):
        assert word in caught.value.hint


def test_what_a_model_says_of_the_first_observation_is_told_as_it_is() -> None:
    far = Far(UngroundedError("no cube"))
    with pytest.raises(UngroundedError, match="no cube"):
        coder().ask(SEEN, far.ask, float("inf"))


def test_a_server_that_is_late_is_no_model_that_remembers() -> None:
    one, far = coder(), Far(None, NotReadyError("late"))
    with pytest.raises(NotReadyError):
        one.ask(SEEN, far.ask, float("inf"))
    assert one.ask(SEEN, far.ask, float("inf")).metrics["shared.parity_m"] == 0.0


@pytest.mark.parametrize("coding", ["raw", "png"])
def test_without_loss_a_model_may_remember(coding: str) -> None:
    far = Far(None, UngroundedError("seen"))
    assert coder(coding).ask(SEEN, far.ask, float("inf")).actions.shape == (2, 7)
    assert len(far.answers) == 1


def test_the_visual_servoing_is_one_of_them() -> None:
    case = contract_case()
    assert case.observe is not None
    servo = case.build()
    servo.load()

    def ask(document: Document, deadline_s: float) -> ActionChunk:
        chunk = servo.predict(to_observation(document))
        return replace(chunk, metrics={"shared.link_ms": 1.0})

    with pytest.raises(ConfigurationError, match="keeps a history of observations"):
        coder().ask(case.observe(), ask, float("inf"))
