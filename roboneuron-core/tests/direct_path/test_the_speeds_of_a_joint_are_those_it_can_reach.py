"""Which velocities a joint can have after a way in a time, worked out by hand."""

from __future__ import annotations

import math

import pytest

from roboneuron.gate.motion.acceleration import Speeds, shortest_s

REST = Speeds(0.0, 0.0)
FREE = math.inf


def test_from_rest_to_rest_takes_a_half_to_accelerate_and_a_half_to_brake() -> None:
    assert shortest_s(0.9, 10.0) == pytest.approx(0.6)
    assert shortest_s(-0.9, 10.0) == pytest.approx(0.6)
    assert shortest_s(0.0, 10.0) == 0.0


def test_a_joint_that_accelerates_all_the_way_has_one_speed_at_its_end() -> None:
    """0.5 * 10 * 0.4 ** 2 from rest: nothing else comes so far."""
    after = REST.after(0.8, 0.4, 10.0, FREE)
    assert after is not None
    assert after.low == pytest.approx(4.0, abs=0.02)
    assert after.high == pytest.approx(4.0, abs=0.02)
    assert REST.after(0.8001, 0.4, 10.0, FREE) is None
    back = REST.after(-0.8, 0.4, 10.0, FREE)
    assert back is not None
    assert back.low == pytest.approx(-4.0, abs=0.02)
    assert REST.after(-0.8001, 0.4, 10.0, FREE) is None


def test_a_joint_that_comes_back_to_where_it_was_may_be_moving_either_way() -> None:
    """It brakes at first and then accelerates: 10 * (2 * sqrt(0.4 ** 2 / 2) - 0.4)."""
    after = REST.after(0.0, 0.4, 10.0, FREE)
    assert after is not None
    fastest = 10.0 * (2.0 * math.sqrt(0.08) - 0.4)
    assert after.high == pytest.approx(fastest, rel=1e-5)
    assert after.low == pytest.approx(-fastest, rel=1e-5)


def test_each_end_of_an_interval_gives_the_other_end_of_the_next() -> None:
    start = Speeds(0.5, 1.5)
    after = start.after(0.5, 0.5, 10.0, FREE)
    assert after is not None
    slow, fast = (Speeds(v, v).after(0.5, 0.5, 10.0, FREE) for v in (0.5, 1.5))
    assert slow is not None
    assert fast is not None
    assert (after.low, after.high) == (fast.low, slow.high)
    assert slow.high > fast.high
    assert slow.low > fast.low


def test_speeds_from_which_the_way_cannot_be_made_do_not_count() -> None:
    wide = Speeds(-50.0, 50.0).after(0.5, 0.5, 10.0, FREE)
    possible = Speeds(1.0 - 2.5, 1.0 + 2.5).after(0.5, 0.5, 10.0, FREE)
    assert wide is not None
    assert possible is not None
    assert wide.low == pytest.approx(possible.low, abs=0.02)
    assert wide.high == pytest.approx(possible.high, abs=0.02)


@pytest.mark.parametrize("speed", [3.6, -1.6])
def test_a_joint_too_fast_or_too_slow_to_make_the_way_makes_it_not(speed: float) -> None:
    assert Speeds(speed, speed).after(0.5, 0.5, 10.0, FREE) is None


def test_no_joint_ends_faster_than_its_limit() -> None:
    after = REST.after(0.1, 0.4, 10.0, 0.5)
    free = REST.after(0.1, 0.4, 10.0, FREE)
    assert after is not None
    assert free is not None
    assert (free.low < -0.5, free.high > 0.5) == (True, True)
    assert (after.low, after.high) == (-0.5, 0.5)
    assert REST.after(0.8, 0.4, 10.0, 3.9) is None, "it could not end as slowly"
    assert REST.after(-0.8, 0.4, 10.0, 3.9) is None
    assert REST.after(0.1, 0.4, 10.0, 0.0) == REST


def test_without_a_limit_of_acceleration_every_speed_can_be_had() -> None:
    assert Speeds(1.0, 1.0).after(5.0, 0.1, math.inf, 2.0) == Speeds(-2.0, 2.0)


def test_one_speed_is_picked_out_of_those_there_are() -> None:
    some = Speeds(-1.0, 2.0)
    for speed in (-1.5, -1.0, 0.0, 2.0, 2.5):
        assert some.at(speed, 0.5) == Speeds(speed, speed)
    assert some.at(-1.6, 0.5) is None
    assert some.at(2.6, 0.5) is None
    assert some.at(2.0) == Speeds(2.0, 2.0)
    assert some.at(2.0 + 1e-5) is None
    assert some.at(-1.0 - 1e-5) is None
