"""How far answers are from what was expected, by channel, in shares of the expected movement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers

F64 = NDArray[np.float64]
LEAST_PAIRS = 10
"""Rows that have to be compared before anything is said of a channel."""
FLOOR = 0.003
"""Shares below this are equal: a policy never repeats its data to the last digit."""


def pairs(predicted: F64, expected: F64) -> tuple[F64, F64]:
    """Predicted and expected values of one channel where both are known, float64 (m,)."""
    known = np.isfinite(predicted) & np.isfinite(expected)
    return predicted[known], expected[known]


def loss_of(predicted: F64, expected: F64, least_spread: float) -> float:
    """Mean squared error in shares of the variance of `expected`, 0 .. 1 (1: as bad as anything);
    NaN when too few rows are known.
    """
    p, e = pairs(predicted, expected)
    if len(p) < LEAST_PAIRS:
        return float("nan")
    variance = max(float(e.var()), least_spread**2)
    return min(1.0, float(((p - e) ** 2).mean()) / variance)


def losses_of(answers: Answers, expected: F64) -> F64:
    """`loss_of` each channel, float64 (C,); `expected` is float64 (N, K, C)."""
    size = answers.space.size
    least = answers.least_spreads(expected.reshape(-1, size))
    return np.array(
        [
            loss_of(answers.predicted[..., c].ravel(), expected[..., c].ravel(), float(least[c]))
            for c in range(size)
        ]
    )


def badness(losses: F64) -> float:
    """Mean logarithm of losses: what is compared between explanations; the smaller the better."""
    return float(np.log(losses + FLOOR).mean())
