"""The paired test compared with scipy's, and with counted numbers."""

from __future__ import annotations

import pytest

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
    from scipy import stats  # heavy

    expected = stats.binomtest(differing[1], count, 0.5)
    assert test.p_value == pytest.approx(expected.pvalue, abs=1e-12)
    interval = expected.proportion_ci(0.95, method="exact")
    assert share_interval(differing[1], count) == pytest.approx((interval.low, interval.high))
    assert test.low <= test.difference <= test.high
    assert test.low == pytest.approx((2 * interval.low - 1) * count / test.seeds)


@pytest.mark.parametrize(
    ("only_champion", "only_challenger", "margin", "is_worse"),
    [
        (1, 0, 0.0, True),
        (1, 0, 0.05, False),
        (6, 0, 0.05, True),
        # 5 of 100 scenes fewer, p = 0.06, and 6, p = 0.03
        (5, 0, 0.07, False),
        (6, 0, 0.07, True),
        (3, 3, 0.0, False),
        (0, 40, 0.0, False),
    ],
)
def test_a_challenger_may_be_worse_by_the_margin_unless_that_is_significant(
    only_champion: int, only_challenger: int, margin: float, is_worse: bool
) -> None:
    others = 100 - only_champion - only_challenger
    test = paired(*outcomes(others, only_champion, only_challenger, 0))
    assert test.is_worse(margin) is is_worse


def test_only_the_same_seeds_are_compared() -> None:
    with pytest.raises(ValueError, match="different seeds"):
        paired({1: True}, {2: True})
