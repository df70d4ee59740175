"""The sliding window of calls."""

from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from roboneuron.direct_path.rate import RateLimit


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
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
        assert sum(start <= t < start + window_s for t in accepted) <= max(
            1, int(rate_hz * window_s + 1e-9)
        )


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


def test_messages_that_follow_each_other_too_fast_are_never_accepted(clock) -> None:
    limit = RateLimit(50.0, clock.monotonic)
    assert limit.take([i * 0.002 for i in range(500)]) == math.inf
    assert limit.take([i * 0.02 for i in range(500)]) == 0.0


def test_messages_still_to_be_sent_count_until_they_are_given_back(clock) -> None:
    limit, owner = RateLimit(2.0, clock.monotonic), object()
    assert limit.take([0.0, 0.5, 1.0, 1.5], owner) == 0.0
    clock.now_s += 0.6
    assert limit.take() > 0.0
    limit.release(owner)
    clock.now_s += 0.4  # the one sent at 0 is a second old, that of 0.5 is not
    assert limit.take() == 0.0
    assert limit.take() > 0.0


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    rate_hz=st.floats(0.2, 20),
    calls=st.lists(
        st.tuples(st.floats(0, 2), st.lists(st.floats(0, 3), min_size=1, max_size=20)), max_size=10
    ),
)
def test_no_window_holds_more_messages_than_the_rate(clock, rate_hz: float, calls) -> None:
    limit = RateLimit(rate_hz, clock.monotonic)
    window_s = max(1.0, 1.0 / rate_hz)
    accepted: list[float] = []
    for gap, offsets in calls:
        clock.now_s += gap
        if limit.take(offsets) == 0.0:
            accepted += [clock.now_s + offset for offset in offsets]
    for start in accepted:
        assert sum(start <= t < start + window_s - 1e-8 for t in accepted) <= max(
            1, int(rate_hz * window_s + 1e-9)
        )
