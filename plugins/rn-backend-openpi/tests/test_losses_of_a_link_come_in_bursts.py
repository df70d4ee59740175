"""The cable of benchmarks/slow_cable.py: the fraction of frames that it loses, and the length of
bursts.
"""

from __future__ import annotations

import random
from itertools import groupby

import pytest
from slow_cable import Link, Losses

STEP_S, STEPS = 0.001, 1_000_000


def test_a_link_is_written_as_four_numbers_and_a_burst() -> None:
    assert Link.of("150/50/1/1000") == Link(150.0, 50.0, 1.0, 1000.0, 0.0)
    assert Link.of("20/0/5~200/2") == Link(20.0, 0.0, 5.0, 2.0, 200.0)


@pytest.mark.parametrize(("text", "burst_s"), [("0/0/5/1000", 0.001), ("0/0/5~200/1000", 0.2)])
def test_bursts_have_their_length_and_the_same_share_is_lost(text: str, burst_s: float) -> None:
    losses = Losses(Link.of(text), random.Random(3))
    lost = [losses.takes(100.0 + number * STEP_S) for number in range(STEPS)]
    # a thousand seconds contain 250 bursts: the standard error of the mean of exponential times is
    # 6 %, with a tolerance of 3 or more of it
    assert sum(lost) / STEPS == pytest.approx(0.05, rel=0.25)
    lengths = [len(list(group)) * STEP_S for is_lost, group in groupby(lost) if is_lost]
    assert sum(lengths) / len(lengths) == pytest.approx(burst_s, rel=0.25)


def test_a_link_without_losses_loses_nothing() -> None:
    for text in ("0/0/0/1000", "0/0/0~100/1000"):
        losses = Losses(Link.of(text), random.Random(1))
        assert not any(losses.takes(float(number)) for number in range(1000))
