"""Success rates of past tasks, by model and instruction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rn_view.sources.records import ShownTask

_Z = 1.959964
"""97.5th percentile of the standard normal distribution."""
_JUDGED = ("succeeded", "failed", "timed_out")
"""Outcomes that count for a model. A person or a stop ended the other tasks."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SuccessRate:
    """Success rate of a model with one instruction.

    Attributes:
        model, instruction: of the tasks; the instruction in lower case.
        succeeded, judged: number of tasks. Stopped, taken-over and unclear tasks are in neither.
        low, high: 95 % Wilson score interval of the success rate.
        median_s: median time of the successful tasks [s]; None without any.
    """

    model: str
    instruction: str
    succeeded: int
    judged: int
    low: float
    high: float
    median_s: float | None


def success_rates(tasks: Sequence[ShownTask]) -> list[SuccessRate]:
    """Success rates by model and instruction, those with the most tasks first.

    Source of the interval: E. B. Wilson, J. Am. Stat. Assoc. 22 (1927), 209.
    """
    groups: dict[tuple[str, str], list[ShownTask]] = {}
    for task in tasks:
        if task.outcome in _JUDGED:
            words = " ".join(task.instruction.lower().split())
            groups.setdefault((task.model, words), []).append(task)
    rates = []
    for (model, words), found in groups.items():
        good = [task.took_s for task in found if task.outcome == "succeeded"]
        low, high = _wilson(len(good), len(found))
        rates.append(
            SuccessRate(
                model=model,
                instruction=words,
                succeeded=len(good),
                judged=len(found),
                low=low,
                high=high,
                median_s=float(np.median(good)) if good else None,
            )
        )
    return sorted(rates, key=lambda rate: rate.judged, reverse=True)


def _wilson(good: int, total: int) -> tuple[float, float]:
    share, z2 = good / total, _Z * _Z
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = _Z * math.sqrt(share * (1 - share) / total + z2 / (4 * total * total)) / (1 + z2 / total)
    return max(0.0, centre - half), min(1.0, centre + half)
