"""Bounds, areas and thresholds of a detector."""

from __future__ import annotations

import numpy as np
import pytest

from rn_policy_cubes.monitor.assessment import JudgedEpisode, summary, table
from rn_policy_cubes.monitor.roc_plot import roc_svg
from rn_policy_cubes.monitor.statistics import area, roc, threshold, upper_bound


@pytest.mark.parametrize(("count", "least"), [(0, 299), (1, 473), (2, 628)])
def test_one_per_cent_needs_so_many_cases(count: int, least: int) -> None:
    assert upper_bound(count, least) <= 0.01 < upper_bound(count, least - 1)


def test_the_bound_is_the_rate_at_which_so_few_are_rare() -> None:
    bound = upper_bound(3, 50)
    drawn = np.random.default_rng(1).binomial(50, bound, 400_000)
    # 5 % with a standard deviation of 0.03 %
    assert (drawn <= 3).mean() == pytest.approx(0.05, abs=0.002)
    assert upper_bound(0, 0) == upper_bound(4, 4) == 1.0


def test_the_area_counts_pairs() -> None:
    assert area([0.9, 0.8], [0.1, 0.2]) == 1.0
    assert area([0.9, 0.1], [0.5, 0.5]) == 0.5
    assert area([0.5], [0.5]) == 0.5
    false, true = roc([0.9, 0.1], [0.5, 0.2])
    assert list(zip(false, true, strict=True)) == [(0, 0), (0, 0.5), (0.5, 0.5), (1, 0.5), (1, 1)]


def test_the_threshold_lies_above_every_negative_case() -> None:
    separate = threshold([0.99] * 20, [0.6, 0.1])
    assert 0.6 < separate < 0.99
    mixed = threshold([0.3, 0.99], [0.9])
    assert 0.9 < mixed < 1.0
    assert threshold([0.99] * 20, [0.0]) >= 0.5


def judged(kind: str, **facts: object) -> JudgedEpisode:
    base: dict[str, object] = {
        "kind": kind,
        "seed": 1,
        "is_success": kind == "success",
        "success": 0.99 if kind == "success" else 0.01,
        "failure": 0.01 if kind == "success" else 0.99,
        "claimed_s": 0.3 if kind == "success" else None,
        "is_false_claim": False,
        "noticed_s": None if kind == "success" else 0.6,
        "is_false_alarm": False,
        "absent": 0.0,
        "first_progress": 0.1,
        "last_progress": 0.9,
    }
    return JudgedEpisode(**(base | facts))  # type: ignore[arg-type]


def test_false_successes_are_counted_by_kind() -> None:
    episodes = [
        *[judged("success")] * 20,
        judged("success", claimed_s=None),
        *[judged("wrong_cube")] * 299,
        judged("dropped", is_false_claim=True, noticed_s=None),
    ]
    lines = table(episodes).splitlines()
    assert "| wrong_cube | 299 | 0 | 1.00 % | 299 | 0.6 s, 0.6 s |" in lines
    assert "| dropped | 1 | 1 | 100.00 % | 0 | - |" in lines
    assert lines[-1].startswith("| all failing | 300 | 1 | 1.57 % | 299 |")
    figures = summary(episodes)
    assert (figures["successes"], figures["found"]) == (21, 20)
    assert (figures["failures"], figures["false_successes"]) == (300, 1)
    assert figures["area_success"] == 1.0
    assert "success: area 1.0000" in roc_svg(episodes)
