"""Without a feature that does better, chunks are executed one after the other, each at its own
period.
"""

from __future__ import annotations

import numpy as np
import pytest

from roboneuron.contract import ActionChunk, Frame, Observation
from roboneuron.errors import ConfigurationError, NotReadyError
from roboneuron.modules.inference.execution import Bounds, ChunkExecutor, make_sequential
from roboneuron.plugins.specs import ActionSpace, BackendSpec

STEP_S = 0.05
BACKEND = BackendSpec(
    name="plain", summary="x", target="x:X", action_space=ActionSpace(step_s=STEP_S)
)


def chunk(rows: int) -> ActionChunk:
    actions = np.zeros((rows, 7))
    actions[:, 0] = np.arange(rows) * 1e-3
    return ActionChunk(actions=actions, step_s=STEP_S)


def observation(captured_ns: int) -> Observation:
    frame = Frame(
        camera="front", image=np.zeros((1, 1, 3), np.uint8), stamp_ns=captured_ns, frame_id="front"
    )
    return Observation(frames={"primary": frame}, instruction="go", stamp_ns=captured_ns)


def answered(rows: int, captured_ns: int = 0) -> ChunkExecutor:
    made = make_sequential(BACKEND, "auto", Bounds(first_s=0.5))
    assert (
        made.answer(made.begin(observation(captured_ns), captured_ns), chunk(rows), captured_ns)
        == "accepted"
    )
    return made


def test_the_next_prediction_waits_for_the_last_row() -> None:
    made = answered(2)
    assert not made.wants_prediction(0.0)
    first, second = made.play(0.0, 0), made.play(STEP_S, 0)
    assert first is not None
    assert second is not None
    assert (first.vector[0], second.vector[0]) == (0.0, 1e-3)
    assert (first.is_border, second.is_border) == (True, False)
    assert not made.wants_prediction(STEP_S)
    assert made.wants_prediction(2 * STEP_S)  # the arm has carried it out
    assert made.values()["mode"] == "sequential"


def test_a_row_is_sent_once_a_period() -> None:
    made = answered(8)
    assert made.play(0.0, 0) is not None
    assert made.play(STEP_S * 0.9, 1) is None
    assert made.play(STEP_S * 1.1, 2) is not None
    assert made.due_s() == pytest.approx(2 * STEP_S)


def test_nothing_of_an_earlier_epoch_is_played() -> None:
    made = answered(8)
    late = made.begin(observation(1), 1)
    made.begin_epoch()
    assert made.due_s() is None
    assert made.answer(late, chunk(8), 2) == "withdrawn"
    assert made.due_s() is None


def test_a_row_of_the_predecessor_takes_the_place_of_ours() -> None:
    made = answered(3)
    made.note_sent(np.zeros(7), 0.01, 1)
    row = made.play(0.01 + STEP_S, 0)
    assert row is not None
    assert row.index == 1


def test_the_first_row_comes_a_period_after_the_predecessors_last() -> None:
    heard_before = make_sequential(BACKEND, "auto", Bounds(first_s=0.5))
    heard_before.note_sent(np.zeros(7), 1.0, 1)
    heard_before.answer(heard_before.begin(observation(2), 2), chunk(3), 2)
    heard_after = answered(3)
    heard_after.note_sent(np.zeros(7), 1.0, 1)
    for made in (heard_before, heard_after):
        assert made.due_s() == pytest.approx(1.0 + STEP_S)
        assert made.play(1.0 + 0.9 * STEP_S, 0) is None
        assert made.play(1.0 + 1.1 * STEP_S, 0) is not None
        # jitter: the predecessor's grid stays
        assert made.due_s() == pytest.approx(1.0 + 2 * STEP_S)


def test_a_row_is_not_sent_when_its_image_is_too_old() -> None:
    made = answered(8)
    with pytest.raises(NotReadyError, match=r"row 1 of 8 was 0\.60 s old"):
        made.play(0.6, int(0.6e9))
    assert made.due_s() is None


@pytest.mark.parametrize("mode", ["overlap", "rtc", "predicted-state"])
def test_a_mode_that_nobody_offers_is_refused(mode: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{mode!r}, which no feature offers") as caught:
        make_sequential(BACKEND, mode, Bounds(first_s=0.5))
    assert "rn-execution" in caught.value.hint
