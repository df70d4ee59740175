"""Goals of one joint in a steady rhythm: commands never exceed them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from gantry import at, limiter, place, profile, to

ACCELERATION, VELOCITY = 20.0, 3.0
PERIODS_S = (1 / 60, 1 / 30, 1 / 15, 0.1)


def commanded(goal: Callable[[float], float], period_s: float, count: int = 60) -> np.ndarray:
    """Goals and the resulting commands, float64 (count, 2), of an arm that starts at rest at 0 and
    follows exactly.
    """
    judge = limiter(robot=profile(ACCELERATION, VELOCITY))
    judge.rest(at(), 10.0)
    rows, here = [], 0.0
    for i in range(count):
        now_s = 10.0 + i * period_s
        wanted = goal(i * period_s)
        here = place(judge.limit(to(wanted, duration_s=period_s), at(here), now_s))[0]
        rows.append((wanted, here))
    return np.array(rows)


@pytest.mark.parametrize("period_s", PERIODS_S)
@pytest.mark.parametrize("jump", [0.02, 0.08, 0.25, -0.4, 1.0, 2.0])
def test_an_arm_stops_at_a_goal_that_jumped(jump: float, period_s: float) -> None:
    rows = commanded(lambda _: jump, period_s, 160)[:, 1] * math.copysign(1.0, jump)
    assert rows.max() == pytest.approx(abs(jump), abs=1e-9)
    assert rows[-1] == pytest.approx(abs(jump), abs=1e-9)


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_a_goal_that_jumps_and_moves_on_is_joined_without_overtaking(period_s: float) -> None:
    rows = commanded(lambda at_s: 0.4 + 0.5 * at_s, period_s, round(2.0 / period_s))
    assert (rows[:, 1] <= rows[:, 0] + 1e-9).all()
    assert rows[-1, 1] == pytest.approx(rows[-1, 0], abs=1e-9)


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_goals_that_an_arm_can_follow_are_followed_exactly(period_s: float) -> None:
    """An oscillation with at most nine tenths of the acceleration limit."""
    turns_s = math.sqrt(0.9 * ACCELERATION / 0.3)
    rows = commanded(lambda at_s: 0.3 * (1.0 - math.cos(turns_s * at_s)), period_s)
    np.testing.assert_allclose(rows[:, 1], rows[:, 0], atol=1e-12)


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_a_goal_that_stops_at_once_is_not_overshot_by_an_arm_that_can_stop(
    period_s: float,
) -> None:
    speed = 0.99 * ACCELERATION * period_s
    rows = commanded(lambda at_s: speed * min(at_s, 5 * period_s), period_s)
    assert rows[:, 1].max() <= rows[:, 0].max() + 1e-9
