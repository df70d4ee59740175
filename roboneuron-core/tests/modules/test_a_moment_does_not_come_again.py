"""Moments of a change-over do not depend on what the clock is set to afterwards."""

from __future__ import annotations

import pytest
from rclpy.parameter import Parameter

from roboneuron.modules.handover import Handover
from roboneuron.modules.settings import ACT_FROM, ACT_UNTIL, NEVER_NS, PLAY_UNTIL

HOUR_NS = 3_600_000_000_000


class Clocks:
    def __init__(self) -> None:
        self.wall_ns = 10**18
        self.mono_s = 100.0

    def set_moment(self, turn: Handover, name: str, moment_ns: int) -> None:
        turn.set([Parameter(name, Parameter.Type.INTEGER, moment_ns)])


@pytest.fixture
def clocks() -> Clocks:
    return Clocks()


@pytest.fixture
def turn(clocks: Clocks) -> Handover:
    return Handover(lambda: clocks.wall_ns, lambda: clocks.mono_s)


@pytest.mark.parametrize("jump_ns", [HOUR_NS, 365 * 24 * HOUR_NS])
def test_a_module_whose_turn_has_come_is_not_in_shadow_again(clocks: Clocks, turn: Handover, jump_ns: int) -> None:
    moment_ns = clocks.wall_ns + 10**8
    clocks.set_moment(turn, ACT_FROM, moment_ns)
    assert turn.is_shadow(moment_ns - 1)
    assert not turn.is_shadow(moment_ns)
    clocks.mono_s += 1.0
    assert turn.is_shadow(moment_ns - 1), "an old input that is still on its way belongs to the old module"
    clocks.mono_s += 10.0
    assert not turn.is_shadow(clocks.wall_ns - jump_ns)


def test_a_module_that_was_replaced_stays_so(clocks: Clocks, turn: Handover) -> None:
    for name in (ACT_UNTIL, PLAY_UNTIL):
        clocks.set_moment(turn, name, clocks.wall_ns)
    clocks.mono_s += 10.0
    assert turn.is_over(clocks.wall_ns - HOUR_NS)
    assert turn.must_fall_silent(clocks.wall_ns - HOUR_NS)


def test_a_moment_made_before_the_clock_was_set_does_not_last_for_ever(clocks: Clocks, turn: Handover) -> None:
    clocks.set_moment(turn, ACT_FROM, clocks.wall_ns + HOUR_NS)
    assert turn.is_shadow(clocks.wall_ns)
    clocks.mono_s += 20.0
    assert not turn.is_shadow(clocks.wall_ns)


def test_without_a_moment_nothing_changes_with_time(clocks: Clocks, turn: Handover) -> None:
    clocks.set_moment(turn, ACT_FROM, NEVER_NS)
    clocks.set_moment(turn, ACT_UNTIL, 0)
    clocks.mono_s += 1e6
    assert turn.is_shadow(clocks.wall_ns)
    assert not turn.is_over(clocks.wall_ns)
