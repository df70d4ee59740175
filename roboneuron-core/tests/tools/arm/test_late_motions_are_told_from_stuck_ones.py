"""A motion that is late but goes on is waited for; one that comes no nearer ends."""

from __future__ import annotations

import pytest

from roboneuron.tools.arm.progress import MotionProgress

PLANNED_S, LONGEST_S, PATIENCE_S = 6.0, 60.0, 3.0


def ended_at_s(left_at, tick_s: float = 0.1) -> float:
    progress = MotionProgress(PLANNED_S, LONGEST_S, PATIENCE_S)
    ticks = (tick * tick_s for tick in range(2000))
    return next(at_s for at_s in ticks if progress.is_stuck(left_at(at_s), at_s))


@pytest.mark.parametrize("slowdown", [1.0, 1.5, 4.0])
def test_an_arm_that_is_late_is_waited_for(slowdown: float) -> None:
    lasts_s = PLANNED_S * slowdown
    ended_s = ended_at_s(lambda at_s: max(0.0, 1.0 - at_s / lasts_s))
    assert ended_s == pytest.approx(lasts_s + PATIENCE_S, abs=0.2)


@pytest.mark.parametrize("stuck_s", [0.0, 2.0, 5.0, 6.0])
def test_an_arm_that_is_stuck_gets_the_patience_after_the_plan(stuck_s: float) -> None:
    ended_s = ended_at_s(lambda at_s: 1.0 - min(at_s, stuck_s) / 10.0)
    assert ended_s == pytest.approx(PLANNED_S + PATIENCE_S, abs=0.2)


def test_an_arm_that_creeps_has_a_bound() -> None:
    assert ended_at_s(lambda at_s: 1.0 - at_s / 1000.0) == pytest.approx(LONGEST_S, abs=0.2)


def test_a_joint_that_trembles_comes_no_nearer() -> None:
    ended_s = ended_at_s(lambda at_s: 0.1 + 1e-4 * (round(at_s * 10) % 2))
    assert ended_s == pytest.approx(PLANNED_S + PATIENCE_S, abs=0.2)
