"""What a backend was asked and answered goes out in words, by the inference module alone."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from recorder_demonstrations import observation

from rn_recorder.plugin import FEATURE
from rn_runs.predictions import join, prediction_record
from roboneuron import ActionChunk
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
    module = SimpleNamespace(describe_prediction=None)
    for extend in joined("inference"):
        extend(module)
    assert module.describe_prediction is prediction_record


def test_a_record_names_the_frames_and_keeps_every_bit_of_the_rows() -> None:
    seen, rows = observation(3, "pick", 0), np.full((2, 7), 1 / 3)
    told = json.loads(prediction_record(seen, "sequential", True, ActionChunk(actions=rows, step_s=0.1)))
    assert (told["instruction"], told["resets"], told["mode"]) == ("pick", True, "sequential")
    assert told["frames"]["primary"] == {"camera": "front", "stamp_ns": seen.stamp_ns}
    assert told["rows"] == rows.tolist()
    assert told["joints"]["position"] == seen.joints.position.tolist()  # type: ignore[union-attr]


def test_a_failure_is_told_in_place_of_rows() -> None:
    told = json.loads(prediction_record(observation(0, "pick", 0), "overlap", False, ValueError("too dark")))
    assert told["error"] == "too dark"
    assert "rows" not in told
