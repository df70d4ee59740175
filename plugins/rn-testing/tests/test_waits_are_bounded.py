"""Waits of tests end when their condition holds, and fail at their time limit."""

from __future__ import annotations

import time

import pytest

from rn_testing.waiting import holds_within, wait_until


def test_a_wait_ends_as_soon_as_its_condition_holds():
    begun_s = time.monotonic()
    took_s = wait_until(lambda: time.monotonic() > begun_s + 0.05, 60.0, "a twentieth of a second")
    assert 0.0 < took_s < 30.0
    assert holds_within(lambda: [0], 60.0)


def test_a_wait_in_vain_says_for_what():
    with pytest.raises(AssertionError, match=r"^not within 0.05 s: the module is gone$"):
        wait_until(lambda: 0, 0.05, "the module is gone")
    assert not holds_within(lambda: None, 0.05)


def test_a_condition_is_asked_once_at_least():
    assert holds_within(lambda: True, 0.0)
    assert not holds_within(lambda: False, 0.0)
