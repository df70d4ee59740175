"""Success rates of past tasks, by model and instruction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist, median

from rn_view.sources.records import ShownTask

_Z = NormalDist().inv_cdf(0.975)
"""For a two-sided interval of 95 %."""
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
    """Success rates by model and instruction, those with the most tasks first."""
    groups: dict[tuple[str, str], list[ShownTask]] = {}
    for task in tasks:
        if task.outcome in _JUDGED:
            words = " ".join(task.instruction.lower().split())
            groups.setdefault((task.model, words), []).append(task)
    rates = []
    for (model, words), found in groups.items():
        good = [task.took_s for task in found if task.outcome == "succeeded"]
        low, high = wilson_interval(len(good), len(found))
        rates.append(
            SuccessRate(
                model=model,
                instruction=words,
                succeeded=len(good),
                judged=len(found),
                low=low,
                high=high,
                median_s=median(good) if good else None,
            )
        )
    return sorted(rates, key=lambda rate: rate.judged, reverse=True)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Score interval of a proportion, 95 %, for at least one trial.

    Not by scipy as in rn-eval: the view would need 100 MB more for these lines. A test compares
    both.

    Source: E. B. Wilson, J. Am. Stat. Assoc. 22 (1927), 209.
    """
    share, z2 = successes / trials, _Z * _Z
    scale = 1 + z2 / trials
    centre = (share + z2 / (2 * trials)) / scale
    variance = share * (1 - share) / trials + z2 / (4 * trials * trials)
    half = _Z * math.sqrt(variance) / scale
    return max(0.0, centre - half), min(1.0, centre + half)
