"""A planar arm that does not follow gets the time that it needs from its position."""

from __future__ import annotations

import numpy as np
from planar import SCALE, START, STEP_S, command, limiter, place, sample, sent

from roboneuron.gate.motion import LimitedCommand, MotionRules


def fastest_m_s(verdict: LimitedCommand, measured: np.ndarray) -> float:
    """Maximum TCP speed from its true position to the end of the command in the command's time."""
    answer = sent(verdict)
    return float(np.linalg.norm(place(answer.position) - place(measured)) / answer.duration_s)


def test_an_arm_that_is_behind_its_setpoint_gets_the_time_that_it_needs_from_where_it_is() -> None:
    judge = limiter(MotionRules(reactions=SCALE, max_speed_m_s=0.1))
    step = np.array([0.01, 0.0])
    judge.limit(command(START + step), sample(START), 1.0)
    frozen = judge.limit(command(START + 2 * step), sample(START), 1.1)
    assert sent(frozen).duration_s > STEP_S
    assert fastest_m_s(frozen, START) <= 0.1
    np.testing.assert_allclose(
        sent(frozen).position, START + 2 * step, err_msg="it is slower, and goes as far"
    )


def test_an_arm_that_follows_gets_no_other_time() -> None:
    judge = limiter(MotionRules(reactions=SCALE, max_speed_m_s=0.5))
    step = np.array([0.01, 0.0])
    judge.limit(command(START + step), sample(START), 1.0)
    assert (
        sent(judge.limit(command(START + 2 * step), sample(START + 0.8 * step), 1.1)).duration_s
        == STEP_S
    )


def test_a_command_without_a_time_is_shortened_when_the_arm_is_behind() -> None:
    judge = limiter(MotionRules(reactions=SCALE, max_speed_m_s=0.1), immediate=True)
    step = np.array([0.01, 0.0])
    for number in (1, 2, 3):
        verdict = judge.limit(command(START + number * step), sample(START), 1.0 + 0.1 * number)
        assert np.linalg.norm(place(sent(verdict).position) - place(START)) <= 0.1 * STEP_S * 1.01
    assert verdict.acted == ("speed",)
