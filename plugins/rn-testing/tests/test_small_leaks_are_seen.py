from __future__ import annotations

import time
from collections import deque

import pytest

from rn_testing import effects
from rn_testing.rule import Violation

KEPT_BYTES = 1024
"""Bytes kept per call: more than allowed for many calls, less than allowed for a few."""


@pytest.fixture
def calls(monkeypatch) -> list[float]:
    """Record the times of all calls; rounds are long enough for MANY of them, however busy the
    machine is.
    """
    monkeypatch.setattr(effects, "ROUND_S", 60.0)
    return []


def slow_call(calls: list[float], kept: list[bytes] | deque[bytes]) -> None:
    time.sleep(2 * effects.QUICK_S)
    calls.append(time.monotonic())
    kept.append(bytes(KEPT_BYTES))


def test_a_slow_call_that_keeps_a_kilobyte_is_seen(calls):
    kept: list[bytes] = []
    with pytest.raises(Violation, match=r"leaks about 1\d\d\d bytes"):
        effects.check_memory(lambda: slow_call(calls, kept), "predict")


@pytest.mark.exhaustive
def test_a_bounded_history_is_no_leak(calls):
    kept: deque[bytes] = deque(maxlen=effects.MANY)
    effects.check_memory(lambda: slow_call(calls, kept), "predict")
    assert len(calls) <= effects.TRIES + effects.ROUNDS * effects.MANY


def test_a_call_that_takes_long_is_made_as_often_as_asked_for(monkeypatch, calls):
    monkeypatch.setattr(effects, "ROUND_S", 0.0)
    effects.check_memory(lambda: slow_call(calls, deque(maxlen=1)), "predict", count=5)
    assert len(calls) == effects.TRIES + 2 * 5  # the first round without growth is the last one
