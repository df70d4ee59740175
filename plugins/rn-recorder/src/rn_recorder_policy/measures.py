"""Measures of each channel's answers against the recording: error, scale, offset,
correlation, lag.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers
from rn_recorder_policy.losses import LEAST_PAIRS, pairs
from rn_recorder_policy.structures import MOST_SHIFT

F64 = NDArray[np.float64]
_FOLLOWS = 0.3
"""Correlation below which the lag is undetermined."""
_LAG_GAIN = 0.01
"""Minimum improvement of the correlation at another lag."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ChannelMeasures:
    """Measures of one channel. Answers are about `scale * recorded + offset`.

    Attributes:
        unit: unit of `rms_error`, `spread` and `offset`.
        rms_error: root of the mean squared difference between answers and recording.
        spread: standard deviation of the recording.
        scale, offset, correlation: of the answers against the recording; None if the recording does
            not move.
        lag_rows: rows by which the answers come too late (negative: too early); None if the
            recording does not move or is not followed.
    """

    channel: str
    unit: str
    rms_error: float
    spread: float
    scale: float | None
    offset: float | None
    correlation: float | None
    lag_rows: int | None

    def to_dict(self) -> Mapping[str, object]:
        """Convert to JSON values."""
        return asdict(self)


def measure(answers: Answers, expected: F64) -> list[ChannelMeasures]:
    """Measures of each channel against `expected`, float64 (N, K, C)."""
    size = answers.space.size
    least = answers.least_spreads(expected.reshape(-1, size))
    shifted = {
        shift: answers.expected(shift=shift)
        for shift in sorted(range(-MOST_SHIFT, MOST_SHIFT + 1), key=abs)
    }
    found = []
    for place, channel in enumerate(answers.space.channels):
        p, e = pairs(answers.predicted[..., place].ravel(), expected[..., place].ravel())
        if len(p) < LEAST_PAIRS:
            p = e = np.zeros(0)
        scale = offset = correlation = lag = None
        spread = float(e.std()) if e.size else 0.0
        if spread >= least[place]:
            scale = float(((p - p.mean()) * (e - e.mean())).mean()) / spread**2
            offset = float(p.mean() - scale * e.mean())
            correlation = _correlation(p, e)
            lag = _lag(answers.predicted[..., place].ravel(), shifted, place)
        found.append(
            ChannelMeasures(
                channel=channel.key,
                unit="0..1" if answers.is_gripper[place] else channel.unit,
                rms_error=float(np.sqrt(((p - e) ** 2).mean())) if p.size else float("nan"),
                spread=spread,
                scale=scale,
                offset=offset,
                correlation=correlation,
                lag_rows=lag,
            )
        )
    return found


def _correlation(p: F64, e: F64) -> float:
    scale = float(p.std() * e.std())
    return float(((p - p.mean()) * (e - e.mean())).mean()) / scale if scale > 0.0 else 0.0


def _lag(predicted: F64, shifted: Mapping[int, F64], place: int) -> int | None:
    """Lag with the largest correlation of either sign, the smallest among nearly equal ones."""
    best, at = _FOLLOWS, None
    for shift, expected in shifted.items():
        p, e = pairs(predicted, expected[..., place].ravel())
        if len(p) >= LEAST_PAIRS and (found := abs(_correlation(p, e))) > best:
            best, at = found + _LAG_GAIN, -shift
    return at
