"""Two faults of LeRobot 0.6.1's real-time engine, demonstrated there, and their absence in the
backend.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_cell import NAMES, RATE_HZ, Load, observe
from lerobot_loops import Call, RealTime

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.exchange import PolicyChunk
from rn_backend_lerobot.plugin import BACKEND
from roboneuron import Ahead
from roboneuron.modules.execution.feature import AdaptiveExecution
from roboneuron.modules.inference import execution

HORIZON, LEFT = 10, 3
"""Number of guided rows, and of rows left to be executed."""
SLOW_S = 0.6
"""Extra time of a policy's first inference: kernels are chosen, memory is allocated."""
PERIOD_S = 1.0 / RATE_HZ


def slow_at_first(policy: Any) -> None:
    """Delay the first chunk."""
    ask, asked = policy.predict_action_chunk, []

    def predict_action_chunk(*arguments: Any, **named: Any) -> Any:
        if not asked:
            time.sleep(SLOW_S)
        asked.append(1)
        return ask(*arguments, **named)

    policy.predict_action_chunk = predict_action_chunk


def test_lerobot_skips_the_first_rows_of_the_first_chunk_and_keeps_the_delay(
    checkpoints: dict[str, Path],
) -> None:
    """The robot stands while the first chunk is computed; LeRobot drops the rows of that time."""
    theirs = RealTime(
        checkpoints["smolvla"], NAMES, fps=RATE_HZ, horizon=HORIZON, wrap=slow_at_first
    )
    with theirs:
        theirs.see(observe(0))
        theirs.wait_for_calls(1)
        first = theirs.engine.get_action(None)
        theirs.continue_on(observe(1))
        theirs.wait_for_calls(2)
    assert first is not None
    call = theirs.calls[0]
    skipped = int(np.abs(call.rows - first.numpy()).sum(axis=1).argmin())
    assert skipped >= math.floor(SLOW_S / PERIOD_S)
    assert theirs.calls[1].delay >= math.floor(SLOW_S / PERIOD_S)


def test_here_the_first_chunk_is_played_from_its_first_row(load: Load) -> None:
    """With a virtual clock: one answer as slow as that, then twenty of 40 ms."""
    backend = load("smolvla", action_steps=16)
    executor = AdaptiveExecution().executor(BACKEND, "rtc", execution.Bounds(first_s=9.0))
    executor.begin_epoch()
    now_s, played, committed = 1.0, [], []
    for number in range(21):
        captured_ns = round(now_s * 1e9)
        prediction = executor.begin(observe(number), captured_ns)
        ahead = prediction.observation.ahead
        committed.append(0 if ahead is None else ahead.committed_rows)
        chunk = backend.predict(prediction.observation)
        took_s = 0.04 if number else SLOW_S
        answered_s, is_answered = now_s + took_s, False
        while not is_answered or not executor.wants_prediction(now_s):
            now_s += 0.005
            if now_s >= answered_s and not is_answered:
                is_answered = True
                assert executor.answer(prediction, chunk, round(now_s * 1e9)) == "accepted"
            row = executor.play(now_s, round(now_s * 1e9))
            if row is not None:
                played.append((number, row))
    first = [row.index for number, row in played if number == 0]
    assert first
    assert first == list(range(len(first)))
    # Each later chunk continues at the current row, and the slow answer counts once.
    second = [row.index for number, row in played if number == 1]
    assert second[0] <= len(first) + 1
    assert max(committed[2:]) <= 3


def continued(checkpoints: dict[str, Path]) -> tuple[Call, Call]:
    """Two calls of LeRobot's engine: the second chunk continues `LEFT` rows of the first one."""
    theirs = RealTime(checkpoints["smolvla"], NAMES, fps=1.0, horizon=HORIZON)
    with theirs:
        theirs.see(observe(0))
        theirs.wait_for_calls(1)
        queue = theirs.engine.action_queue
        assert queue is not None
        theirs.engine.pause()
        while queue.qsize() > LEFT:
            theirs.engine.get_action(None)
        theirs.continue_on(observe(1))
        theirs.wait_for_calls(2)
    return theirs.calls[0], theirs.calls[1]


def test_lerobot_pads_a_short_prefix_and_lands_at_the_mean_and_this_does_not(
    checkpoints: dict[str, Path], load: Load
) -> None:
    """Zeros after the remaining rows stand for the mean of the training data."""
    first, second = continued(checkpoints)
    padded = slice(LEFT, LEFT + 5)
    assert second.left is not None
    assert not second.left[LEFT:].any()
    backend = load("smolvla", rtc_horizon=HORIZON, action_steps=16)
    running = answer(backend, first, None)
    ahead = Ahead(
        rows=running.rows[-LEFT:],
        committed_rows=min(second.delay, LEFT),
        step_s=PERIOD_S,
        context=running,
        context_row=len(running.rows) - LEFT,
    )
    ours = answer(backend, second, ahead)
    spread = {
        name: float(rows[padded].abs().mean())
        for name, rows in (("theirs", second.normalized), ("ours", ours.normalized))
    }
    assert spread["theirs"] < 0.2, "standard deviations from the mean"
    assert spread["ours"] > 0.5
    # Both keep the remaining rows.
    kept = running.rows[-LEFT:]
    for rows in (second.rows, ours.rows):
        np.testing.assert_allclose(rows[0], kept[0], rtol=0, atol=0.02)


def answer(backend: LeRobotBackend, call: Call, ahead: Ahead | None) -> PolicyChunk:
    """The answer with the noise that LeRobot drew."""
    assert backend._engine is not None
    backend._engine._noise._states = [call.random]
    seen = observe(0 if ahead is None else 1)
    context = backend.predict(replace(seen, ahead=ahead)).context
    assert isinstance(context, PolicyChunk)
    return context
