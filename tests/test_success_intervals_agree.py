"""The view and the evaluation report give the same interval for the same counts."""

from __future__ import annotations

import pytest

from rn_eval.statistics import proportion
from rn_view.tasks.success_rates import wilson_interval


@pytest.mark.parametrize("trials", [1, 2, 7, 50, 500])
def test_the_view_gives_the_interval_of_the_evaluation(trials: int) -> None:
    for successes in range(trials + 1):
        by_scipy = proportion(successes, trials)
        # the same formula in another order of operations
        assert wilson_interval(successes, trials) == pytest.approx(
            (by_scipy.low, by_scipy.high), abs=1e-12
        )
