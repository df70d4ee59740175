"""How many messages a window takes, and how long the next one has to wait, to the message."""

from __future__ import annotations

import math
from typing import Any

import pytest

from roboneuron.direct_path.rate import RateLimit


@pytest.mark.parametrize(
    ("rate_hz", "most", "window_s"),
    [
        *((0.1, 1, 10.0), (0.3, 1, 1.0 / 0.3), (0.5, 1, 2.0), (0.99, 1, 1.0 / 0.99)),
        *((1.0, 1, 1.0), (1.5, 1, 1.0), (2.0, 2, 1.0), (2.9, 2, 1.0), (20.0, 20, 1.0)),
    ],
)
def test_a_window_takes_so_many_messages_and_no_more(
    clock: Any, rate_hz: float, most: int, window_s: float
) -> None:
    limit = RateLimit(rate_hz, clock.monotonic)
    assert limit.rate_hz == rate_hz
    assert [limit.take() for _ in range(most)] == [0.0] * most
    assert limit.wait_s() == pytest.approx(window_s)
    assert limit.take() == pytest.approx(window_s), "it was not counted"
    clock.now_s += window_s * 0.999
    assert limit.take() > 0.0
    clock.now_s += window_s * 0.001 + 1e-9
    assert limit.wait_s() == 0.0
    assert limit.take() == 0.0


def test_several_messages_wait_until_there_is_room_for_all(clock: Any) -> None:
    limit = RateLimit(3.0, clock.monotonic)
    for _ in range(3):
        assert limit.take() == 0.0
        clock.now_s += 0.1
    assert limit.wait_s() == pytest.approx(0.7)
    assert limit.wait_s((0.0, 0.0)) == pytest.approx(0.8)
    assert limit.wait_s((0.0, 0.0, 0.0)) == pytest.approx(0.9)
    assert limit.wait_s((0.0,) * 4) == math.inf
    assert limit.take((0.7, 0.8, 0.9)) == 0.0


def test_messages_may_follow_each_other_as_fast_as_the_rate_whatever_sums_round_to(
    clock: Any,
) -> None:
    clock.now_s = 0.0
    limit = RateLimit(1.0, clock.monotonic)
    assert limit.wait_s((0.0, 1.0)) == 0.0
    assert limit.wait_s((0.0, 1.0 - 1e-9)) == 0.0
    assert limit.wait_s((0.0, 1.0 - 1e-6)) == math.inf
    assert limit.wait_s((1.0, 0.0)) == 0.0, "their order does not matter"


def test_messages_that_are_still_to_be_sent_keep_others_from_being_sent_before_them(
    clock: Any,
) -> None:
    limit = RateLimit(1.0, clock.monotonic)
    assert limit.take((0.5,)) == 0.0
    assert limit.wait_s() > 0.0
    assert limit.wait_s((1.4,)) > 0.0
    assert limit.wait_s((1.5,)) == 0.0
    assert limit.take((1.5,)) == 0.0


def test_only_what_was_not_sent_yet_is_given_back(clock: Any) -> None:
    limit, owner, other = RateLimit(2.0, clock.monotonic), object(), object()
    assert limit.take((0.0, 0.5), owner) == 0.0
    clock.now_s += 0.5
    limit.release(owner)
    assert limit.wait_s() == pytest.approx(0.5), "that of this moment has been sent"
    clock.now_s += 2.0
    assert limit.take((0.5, 0.6), owner) == 0.0
    limit.release(other)
    assert limit.take() > 0.0
    limit.release(owner)
    assert limit.take((0.0, 0.0)) == 0.0


def test_messages_without_an_owner_are_not_given_back_with_others(clock: Any) -> None:
    limit = RateLimit(1.0, clock.monotonic)
    assert limit.take((0.5,)) == 0.0
    limit.release(object())
    assert limit.take() > 0.0
