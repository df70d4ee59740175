"""Champion and challenger on the same episodes: the exact paired test, and an interval.

Source: McNemar 1947, exact as a sign test of the pairs that differ; Clopper and Pearson 1934 for
the interval of their proportion, from which that of the difference follows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import comb

CONFIDENCE = 0.95
SIGNIFICANT = 0.05
_HALVINGS = 50


@dataclass(frozen=True, kw_only=True, slots=True)
class PairedTest:
    """Comparison of two policies on the same seeds.

    Attributes:
        seeds: number of seeds.
        champion, challenger: number of successes of each.
        only_champion, only_challenger: seeds solved by only one.
        difference: success rate of the challenger minus that of the champion, -1 .. 1.
        low, high: its 95 % interval, given the number of differing pairs.
        p_value: two-sided.
    """

    seeds: int
    champion: int
    challenger: int
    only_champion: int
    only_challenger: int
    difference: float
    low: float
    high: float
    p_value: float

    def is_worse(self, margin: float) -> bool:
        """Whether the challenger counts as worse: it solves fewer by more than the margin (share of
        the scenes, 0 .. 1), or by less and the test finds that significant.
        """
        is_significant = self.p_value < SIGNIFICANT
        return self.difference < -margin or (self.difference < 0 and is_significant)

    def __str__(self) -> str:
        """Text for people."""
        champion, challenger = (
            f"{count}/{self.seeds} ({100 * count / self.seeds:.1f} %)"
            for count in (self.champion, self.challenger)
        )
        return (
            f"champion {champion}, challenger {challenger}; alone {self.only_champion} and "
            f"{self.only_challenger}; {100 * self.difference:+.1f} points "
            f"[{100 * self.low:+.1f}, {100 * self.high:+.1f}], p = {self.p_value:.3g}"
        )


def paired(champion: Mapping[int, bool], challenger: Mapping[int, bool]) -> PairedTest:
    """Compare success by seed. Both have the same seeds, at least one."""
    if champion.keys() != challenger.keys() or not champion:
        raise ValueError("champion and challenger were tried on different seeds")
    count = len(champion)
    only_champion = sum(champion[seed] and not challenger[seed] for seed in champion)
    only_challenger = sum(challenger[seed] and not champion[seed] for seed in champion)
    differing = only_champion + only_challenger
    low, high = share_interval(only_challenger, differing)
    least = min(only_champion, only_challenger)
    return PairedTest(
        seeds=count,
        champion=sum(champion.values()),
        challenger=sum(challenger.values()),
        only_champion=only_champion,
        only_challenger=only_challenger,
        difference=(only_challenger - only_champion) / count,
        low=(2 * low - 1) * differing / count,
        high=(2 * high - 1) * differing / count,
        p_value=min(1.0, 2.0 * _at_most(least, differing, 0.5)) if differing else 1.0,
    )


def share_interval(successes: int, trials: int) -> tuple[float, float]:
    """Exact interval of a proportion (Clopper and Pearson); 0 and 1 without trials."""
    tail = (1.0 - CONFIDENCE) / 2
    low, high = 0.0, 1.0
    if successes > 0:
        low = _root(lambda share: 1.0 - _at_most(successes - 1, trials, share) - tail)
    if successes < trials:
        high = _root(lambda share: tail - _at_most(successes, trials, share))
    return low, high


def _at_most(successes: int, trials: int, share: float) -> float:
    """Probability of at most `successes` successes."""
    terms = (
        comb(trials, k) * share**k * (1.0 - share) ** (trials - k) for k in range(successes + 1)
    )
    return sum(terms)


def _root(rising: Callable[[float], float]) -> float:
    """Root of a function that rises between 0 and 1."""
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if rising(middle) < 0:
            low = middle
        else:
            high = middle
    return (low + high) / 2
