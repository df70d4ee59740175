"""Statistics of a data set's features in LeRobotDataset v3, for each episode and for all.

Source: lerobot 0.6.1, `datasets/compute_stats.py`: keys, and images as fractions of 255 over a
sample of pixels, in the shape (3, 1, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)


@dataclass(frozen=True, slots=True)
class Stats:
    """Statistics of one feature; arrays have its shape."""

    min: F64
    max: F64
    mean: F64
    std: F64
    quantiles: F64
    count: int

    def to_lists(self) -> dict[str, list[object]]:
        """Convert to the files' format."""
        named = {"min": self.min, "max": self.max, "mean": self.mean, "std": self.std}
        named |= {f"q{round(q * 100):02d}": self.quantiles[i] for i, q in enumerate(QUANTILES)}
        return {**{name: value.tolist() for name, value in named.items()}, "count": [self.count]}


def stats_of(values: F64, count: int | None = None) -> Stats:
    """Statistics of rows (N, ...)."""
    return Stats(
        values.min(axis=0),
        values.max(axis=0),
        values.mean(axis=0),
        values.std(axis=0),
        np.quantile(values, QUANTILES, axis=0),
        len(values) if count is None else count,
    )


def image_stats(pixels: F64, frames: int) -> Stats:
    """Statistics of pixels (N, 3) in 0 .. 1, sampled from that many frames."""
    flat = stats_of(pixels, frames)
    shape = (3, 1, 1)
    return Stats(
        flat.min.reshape(shape),
        flat.max.reshape(shape),
        flat.mean.reshape(shape),
        flat.std.reshape(shape),
        flat.quantiles.reshape(len(QUANTILES), *shape),
        frames,
    )


def merge(parts: Sequence[Stats]) -> Stats:
    """Merge the statistics of all episodes; quantiles are their weighted mean, as in lerobot."""
    weights = np.array([part.count for part in parts], dtype=np.float64)
    weights /= weights.sum()

    def mean_of(values: list[F64]) -> F64:
        return np.asarray(np.tensordot(weights, np.stack(values), axes=1), dtype=np.float64)

    mean = mean_of([part.mean for part in parts])
    variance = mean_of([part.std**2 + (part.mean - mean) ** 2 for part in parts])
    return Stats(
        np.min([part.min for part in parts], axis=0),
        np.max([part.max for part in parts], axis=0),
        mean,
        np.sqrt(variance),
        mean_of([part.quantiles for part in parts]),
        sum(part.count for part in parts),
    )
