"""What a handover lets through of an inference module: images to predict on, answers to act on."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron import ACTION_FIELDS, ActionChunk, NotReadyError, Observation
from roboneuron.modules.inference.execution import Prediction
from roboneuron.modules.predictions import AnsweredPrediction
from roboneuron.modules.status import StatusWriter
from roboneuron.modules.step_filters import StepFilters
from roboneuron.switching.handover import TimedHandover
from roboneuron.switching.inference_handover import InferenceHandover
from roboneuron.switching.standby import ACT_FROM, ACT_UNTIL

NOW_NS = 10**18
CHUNK = ActionChunk(actions=np.full((1, 7), 0.5), step_s=0.1)


class Cell:
    """An inference module that notes what it was asked to do."""

    def __init__(self) -> None:
        self.status = StatusWriter("fake/inference")
        self.handover = TimedHandover(True, self.status, lambda: NOW_NS, lambda: 100.0)
        self.called: list[str] = []
        module: Any = SimpleNamespace(
            status=self.status,
            node=SimpleNamespace(now_ns=lambda: NOW_NS),
            config=SimpleNamespace(inference=SimpleNamespace(max_image_age_s=0.5)),
            executor=SimpleNamespace(measure=lambda *_: self.called.append("measure")),
            note_first=lambda oldest_ns: self.called.append(f"first of {oldest_ns - NOW_NS}"),
        )
        self.filters = StepFilters([self.handover, InferenceHandover(module, self.handover)])

    def accepts(self, captured_ns: int) -> bool:
        return self.filters.admits(captured_ns)

    def deliver(self, captured_ns: int) -> None:
        seen = Observation(
            frames={},
            instruction="go",
            joints=None,
            ee_pose=None,
            gripper_open=None,
            stamp_ns=captured_ns,
        )
        prediction = Prediction(observation=seen, captured_ns=captured_ns, epoch=0)
        answer = AnsweredPrediction(prediction=prediction, chunk=CHUNK, stop=threading.Event())
        self.filters.deliver(answer, lambda _: self.called.append("deliver"))


@pytest.fixture
def cell() -> Cell:
    return Cell()


def test_in_shadow_an_answer_is_measured_and_proves_readiness(cell: Cell) -> None:
    cell.deliver(NOW_NS - 7)
    assert cell.called == ["measure", "first of -7"]
    report = cell.status.report()
    assert report.note == "in shadow"
    assert report.metrics[f"shadow_action.{ACTION_FIELDS[0]}"] == "0.5"


def test_after_the_handover_an_answer_is_executed(cell: Cell) -> None:
    cell.handover.set(ACT_FROM, NOW_NS - 8)
    cell.deliver(NOW_NS - 7)
    assert cell.called == ["deliver"]


def test_an_answer_that_is_late_in_shadow_proves_nothing(cell: Cell) -> None:
    with pytest.raises(NotReadyError, match=r"an image that was 0\.60 s old"):
        cell.deliver(NOW_NS - 600_000_000)
    assert cell.called == ["measure"]
    assert cell.status.report().dropped_by == {"late_action": 1}


def test_an_image_from_before_the_rest_is_left_out(cell: Cell) -> None:
    cell.handover.not_before_ns = NOW_NS
    assert not cell.accepts(NOW_NS - 1)
    assert cell.accepts(NOW_NS)


def test_an_image_of_the_successor_is_left_to_it(cell: Cell) -> None:
    cell.handover.set(ACT_UNTIL, NOW_NS)
    assert cell.accepts(NOW_NS - 1)
    assert cell.status.report().note == ""
    assert not cell.accepts(NOW_NS)
    assert cell.status.report().note == "handed over to the successor"
