"""The paired test compared with scipy's, and with counted numbers."""

from __future__ import annotations

import pytest
from scipy import stats

from rn_policy_cubes.paired import paired, share_interval


def outcomes(both: int, first: int, second: int, neither: int) -> tuple[dict[int, bool], ...]:
    pairs = [(True, True)] * both + [(True, False)] * first
    pairs += [(False, True)] * second + [(False, False)] * neither
    return tuple({seed: pair[side] for seed, pair in enumerate(pairs)} for side in (0, 1))


@pytest.mark.parametrize("differing", [(0, 0), (1, 0), (3, 9), (12, 12), (40, 2)])
def test_it_is_the_exact_test(differing: tuple[int, int]) -> None:
    test = paired(*outcomes(50, *differing, 5))
    assert (test.champion, test.challenger) == (50 + differing[0], 50 + differing[1])
    count = sum(differing)
    if not count:
        assert (test.difference, test.low, test.high, test.p_value) == (0.0, 0.0, 0.0, 1.0)
        return
    expected = stats.binomtest(differing[1], count, 0.5)
    assert test.p_value == pytest.approx(expected.pvalue, abs=1e-12)
    interval = expected.proportion_ci(0.95, method="exact")
    assert share_interval(differing[1], count) == pytest.approx((interval.low, interval.high))
    assert test.low <= test.difference <= test.high
    assert test.low == pytest.approx((2 * interval.low - 1) * count / test.seeds)


def test_only_the_same_seeds_are_compared() -> None:
    with pytest.raises(ValueError, match="different seeds"):
        paired({1: True}, {2: True})
