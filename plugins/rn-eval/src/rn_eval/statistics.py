"""Statistics of the report: proportions with Wilson intervals, paired comparisons, percentiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rn_eval.record import EpisodeRecord

CONFIDENCE = 0.95


class Proportion(NamedTuple):
    """Number of successes and trials with the Wilson interval.

    Attributes:
        successes, trials: counts.
        low, high: bounds of the proportion, 0 .. 1.
    """

    successes: int
    trials: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """Proportion, 0 .. 1; NaN without trials."""
        return self.successes / self.trials if self.trials else float("nan")

    def __str__(self) -> str:
        if not self.trials:
            return "-"
        return f"{100 * self.share:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"


def proportion(successes: int, trials: int, confidence: float = CONFIDENCE) -> Proportion:
    """A proportion with its Wilson score interval (without continuity correction).

    Source: Wilson 1927; computed by scipy.stats.binomtest.
    """
    if not trials:
        return Proportion(0, 0, 0.0, 1.0)
    from scipy import stats  # takes a second to import

    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return Proportion(successes, trials, float(interval.low), float(interval.high))


class Paired(NamedTuple):
    """Comparison of two variants on the same episodes.

    Attributes:
        pairs: number of episodes with a verdict for both.
        only_first, only_second: number solved by only one of them.
        p_value: two-sided, exact McNemar test; 1 if they never differ.
        difference: success rate of the second minus that of the first, over the pairs, -1 .. 1.
    """

    pairs: int
    only_first: int
    only_second: int
    p_value: float
    difference: float


def mcnemar(first: Mapping[object, bool], second: Mapping[object, bool]) -> Paired:
    """Compare success by episode; episodes missing on one side are left out.

    Source: McNemar 1947; the exact test is a binomial test over the differing pairs, with
    probability 1/2.
    """
    from scipy import stats

    common = first.keys() & second.keys()
    only_first = sum(first[key] and not second[key] for key in common)
    only_second = sum(second[key] and not first[key] for key in common)
    differing = only_first + only_second
    p_value = float(stats.binomtest(only_first, differing, 0.5).pvalue) if differing else 1.0
    difference = (only_second - only_first) / len(common) if common else float("nan")
    return Paired(len(common), only_first, only_second, p_value, difference)


class Spread(NamedTuple):
    """Number, mean, median and 95th percentile of some values; NaN without any."""

    size: int
    mean: float
    p50: float
    p95: float


def spread(values: Sequence[float]) -> Spread:
    """Summarise values."""
    if not len(values):
        return Spread(0, float("nan"), float("nan"), float("nan"))
    array = np.asarray(values, dtype=np.float64)
    p50, p95 = np.percentile(array, [50, 95])
    return Spread(len(array), float(array.mean()), float(p50), float(p95))


def success_of(records: Sequence[EpisodeRecord]) -> Proportion:
    """Success rate over the episodes with a verdict; crashes ("error") have none."""
    judged = [record for record in records if record.outcome.status != "error"]
    return proportion(sum(record.outcome.status == "success" for record in judged), len(judged))


def verdicts(records: Sequence[EpisodeRecord]) -> dict[object, bool]:
    """Success by the key that pairs episodes of different variants."""
    return {
        (record.key.suite, record.key.task, record.key.seed): record.outcome.status == "success"
        for record in records
        if record.outcome.status != "error"
    }


def inference_ms(records: Sequence[EpisodeRecord]) -> list[float]:
    """Duration of every prediction [ms], without those right after loading."""
    return [ms for record in records for ms in record.measured.inference_ms[record.measured.cold :]]
