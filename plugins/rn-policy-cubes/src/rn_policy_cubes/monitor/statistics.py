"""Statistics of a detector: exact bounds of rates, ROC curve, and choice of a threshold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
CONFIDENCE = 0.95


def upper_bound(count: int, cases: int, confidence: float = CONFIDENCE) -> float:
    """Exact one-sided upper bound of a rate of which `count` of `cases` were seen; 1 without cases.

    It is the rate at which so few would be seen with a probability of 1 - confidence.

    Source: Clopper and Pearson 1934.
    """
    if cases == 0 or count >= cases:
        return 1.0
    low, high = count / cases, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if _at_most(count, cases, middle) > 1.0 - confidence:
            low = middle
        else:
            high = middle
    return high


def _at_most(count: int, cases: int, rate: float) -> float:
    """Probability of at most `count` of `cases` at a rate."""
    if rate <= 0.0:
        return 1.0
    if rate >= 1.0:
        return 0.0
    total = 0.0
    for found in range(count + 1):
        log = math.lgamma(cases + 1) - math.lgamma(found + 1) - math.lgamma(cases - found + 1)
        log += found * math.log(rate) + (cases - found) * math.log1p(-rate)
        total += math.exp(log)
    return min(total, 1.0)


def roc(positive: Sequence[float], negative: Sequence[float]) -> tuple[F64, F64]:
    """Rates of false and true alarms at every threshold, from none to all; each float64 (n,)."""
    scores = np.concatenate([positive, negative])
    thresholds = np.concatenate([[np.inf], np.unique(scores)[::-1]])
    good, bad = np.asarray(positive), np.asarray(negative)
    true = np.array([(good >= threshold).mean() for threshold in thresholds])
    false = np.array([(bad >= threshold).mean() for threshold in thresholds])
    return false, true


def area(positive: Sequence[float], negative: Sequence[float]) -> float:
    """Area under the ROC curve: the probability that a positive case scores higher."""
    good, bad = np.asarray(positive)[:, None], np.asarray(negative)[None]
    return float(((good > bad) + 0.5 * (good == bad)).mean())


def threshold(positive: Sequence[float], negative: Sequence[float]) -> float:
    """A threshold above every negative case: half-way, in log-odds, to the 5 % quantile of the
    positive ones, or just above the highest negative one if that is higher.
    """
    highest = min(max(float(np.max(negative)), 1e-3), 1.0 - 1e-4)
    usual = min(float(np.quantile(positive, 0.05)), 1.0 - 1e-6)
    if usual <= highest:
        return highest + 0.1 * (1.0 - highest)
    middle = (_logit(highest) + _logit(usual)) / 2
    return min(max(1.0 / (1.0 + math.exp(-middle)), 0.5), 1.0 - 1e-4)


def _logit(value: float) -> float:
    return math.log(value / (1.0 - value))
