"""The sliding window of calls."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from roboneuron.gate.rate import RateLimit


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rate_hz=st.floats(0.1, 50), gaps=st.lists(st.floats(0, 0.5), max_size=80))
def test_no_second_holds_more_calls_than_the_rate(clock, rate_hz: float, gaps: list[float]) -> None:
    limit = RateLimit(rate_hz, clock.monotonic)
    window_s = max(1.0, 1.0 / rate_hz)
    accepted: list[float] = []
    for gap in gaps:
        clock.now_s += gap
        expected = limit.wait_s()
        if limit.take() == 0.0:
            assert expected == 0.0
            accepted.append(clock.now_s)
        else:
            assert expected > 0.0
    for start in accepted:
        assert sum(start <= t < start + window_s for t in accepted) <= max(1, int(rate_hz * window_s + 1e-9))


def test_no_rate_is_no_bound(clock) -> None:
    limit = RateLimit(0.0, clock.monotonic)
    assert [limit.take() for _ in range(1000)] == [0.0] * 1000


def test_the_answer_says_how_long_to_wait(clock) -> None:
    limit = RateLimit(0.5, clock.monotonic)
    assert limit.take() == 0.0
    clock.now_s += 0.5
    assert limit.take() == pytest.approx(1.5)
    clock.now_s += 1.5
    assert limit.take() == 0.0
