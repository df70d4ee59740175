"""Differences between answers and expected values by channel, as fractions of the expected
movement.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers

F64 = NDArray[np.float64]
LEAST_PAIRS = 10
"""Minimum number of compared rows for a statement on a channel."""
FLOOR = 0.003
"""Losses below this count as equal: a policy never repeats its data exactly."""


def pairs(predicted: F64, expected: F64) -> tuple[F64, F64]:
    """Predicted and expected values of one channel, if both are known, float64 (m,)."""
    known = np.isfinite(predicted) & np.isfinite(expected)
    return predicted[known], expected[known]


def loss_of(predicted: F64, expected: F64, least_spread: float) -> float:
    """Mean squared error as a fraction of the variance of `expected`, 0 .. 1 (1 is the maximum);
    NaN if too few rows are known.
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
    """Mean logarithm of losses, by which explanations are compared; smaller is better."""
    return float(np.log(losses + FLOOR).mean())
