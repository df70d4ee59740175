"""What a backend was asked and answered goes out in words, by the inference module alone."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from recorder_demonstrations import PERIOD_NS, observation

from rn_recorder.plugin import FEATURE
from rn_recorder_runs.predictions import PredictionRecords, join, prediction_record
from roboneuron import ActionChunk
from roboneuron.modules.inference.execution import Prediction
from roboneuron.modules.step_filters import StepFilters
from roboneuron.plugins.loading import load_attribute


def joined(kind: str) -> list[Any]:
    """What the feature wants done with the module of a process of that kind."""
    host = SimpleNamespace(settings=SimpleNamespace(kind=kind), on_configured=[])
    join(cast("Any", host))
    return host.on_configured


@pytest.mark.parametrize("kind", ["robot", "perception", "control"])
def test_other_modules_are_left_alone(kind: str) -> None:
    assert joined(kind) == []


def test_the_inference_module_is_given_the_words() -> None:
    assert load_attribute(str(FEATURE.on_join), "on_join") is join
    published: list[str] = []
    output = SimpleNamespace(
        get_subscription_count=lambda: 1, publish=lambda message: published.append(message.data)
    )
    advertised: list[str] = []

    def advertise(message_type: type, topic: str) -> Any:
        advertised.append(topic)
        return output

    module = SimpleNamespace(filters=StepFilters(), node=SimpleNamespace(advertise=advertise))
    for extend in joined("inference"):
        extend(module)
    assert advertised == ["predictions"]
    (listener,) = module.filters
    seen = Prediction(observation=observation(0, "pick", 0), captured_ns=0, epoch=0, mode="overlap")
    listener.note_answer(seen, True, ValueError("too dark"))
    assert [json.loads(text)["error"] for text in published] == ["too dark"]


def test_a_record_names_the_frames_and_keeps_every_bit_of_the_rows() -> None:
    seen, rows = observation(3, "pick", 0), np.full((2, 7), 1 / 3)
    told = json.loads(
        prediction_record(seen, "sequential", True, ActionChunk(actions=rows, step_s=0.1))
    )
    assert (told["instruction"], told["resets"], told["mode"]) == ("pick", True, "sequential")
    assert told["frames"]["primary"] == {"camera": "front", "stamp_ns": seen.stamp_ns}
    assert told["rows"] == rows.tolist()
    assert told["joints"]["position"] == seen.joints.position.tolist()  # type: ignore[union-attr]


def test_a_failure_is_told_in_place_of_rows() -> None:
    told = json.loads(
        prediction_record(observation(0, "pick", 0), "overlap", False, ValueError("too dark"))
    )
    assert told["error"] == "too dark"
    assert "rows" not in told


def numbers(records: PredictionRecords, *predictions: tuple[int, bool, bool]) -> list[list[int]]:
    """The numbers of what is published after each prediction (number, resets, is_heard)."""
    chunk = ActionChunk(actions=np.zeros((1, 7)), step_s=0.1)
    published = []
    for number, resets, is_heard in predictions:
        texts = records(observation(number, "pick", 0), "sequential", resets, chunk, is_heard)
        published.append([json.loads(text)["stamp_ns"] // PERIOD_NS for text in texts])
    return published


def test_a_recorder_that_finds_the_topic_late_gets_the_predictions_since_the_reset() -> None:
    late = [(0, True, False), (1, False, False), (2, False, True), (3, False, True)]
    again = [(4, False, False), (5, False, True)]
    assert numbers(PredictionRecords(), *late, *again) == [[], [], [0, 1, 2], [3], [], [5]]


def test_predictions_that_nobody_hears_of_are_not_kept_for_long() -> None:
    alone = [(number, number in (0, 30), False) for number in range(25)]
    assert numbers(PredictionRecords(), *alone, (25, False, True))[-1] == [25]
    assert numbers(PredictionRecords(), *alone, (30, True, False), (31, False, True))[-1] == [
        30,
        31,
    ]
