"""Moments of a change-over do not depend on what the clock is set to afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from roboneuron.contract import ActionChunk
from roboneuron.modules.status import StatusWriter
from roboneuron.switching.handover import TimedHandover
from roboneuron.switching.standby import ACT_FROM, ACT_UNTIL, NEVER_NS, PLAY_FROM, PLAY_UNTIL

HOUR_NS = 3_600_000_000_000


class Clocks:
    def __init__(self) -> None:
        self.wall_ns = 10**18
        self.mono_s = 100.0

    def set_moment(self, handover: TimedHandover, name: str, moment_ns: int) -> None:
        handover.set(name, moment_ns)


@pytest.fixture
def clocks() -> Clocks:
    return Clocks()


@pytest.fixture
def handover(clocks: Clocks) -> TimedHandover:
    return TimedHandover(
        False, StatusWriter("fake/inference"), lambda: clocks.wall_ns, lambda: clocks.mono_s
    )


@pytest.mark.parametrize("jump_ns", [HOUR_NS, 365 * 24 * HOUR_NS])
def test_a_module_that_has_taken_over_is_not_in_shadow_again(
    clocks: Clocks, handover: TimedHandover, jump_ns: int
) -> None:
    moment_ns = clocks.wall_ns + 10**8
    clocks.set_moment(handover, ACT_FROM, moment_ns)
    assert not handover.sends(moment_ns - 1)
    assert handover.sends(moment_ns)
    clocks.mono_s += 1.0
    assert not handover.sends(moment_ns - 1), (
        "an old input that is still on its way belongs to the old module"
    )
    clocks.mono_s += 10.0
    assert handover.sends(clocks.wall_ns - jump_ns)


def test_a_module_that_was_replaced_stays_so(clocks: Clocks, handover: TimedHandover) -> None:
    for name in (ACT_UNTIL, PLAY_UNTIL):
        clocks.set_moment(handover, name, clocks.wall_ns)
    clocks.mono_s += 10.0
    assert not handover.admits(clocks.wall_ns - HOUR_NS)
    assert handover.ends_rows(clocks.wall_ns - HOUR_NS)


def test_a_moment_made_before_the_clock_was_set_does_not_last_for_ever(
    clocks: Clocks, handover: TimedHandover
) -> None:
    clocks.set_moment(handover, ACT_FROM, clocks.wall_ns + HOUR_NS)
    assert not handover.sends(clocks.wall_ns)
    clocks.mono_s += 20.0
    assert handover.sends(clocks.wall_ns)


def test_without_a_moment_nothing_changes_with_time(
    clocks: Clocks, handover: TimedHandover
) -> None:
    clocks.set_moment(handover, ACT_FROM, NEVER_NS)
    clocks.set_moment(handover, ACT_UNTIL, 0)
    clocks.mono_s += 1e6
    assert not handover.sends(clocks.wall_ns)
    assert handover.admits(clocks.wall_ns)


def test_a_standby_is_in_shadow_until_it_is_told_otherwise(clocks: Clocks) -> None:
    standby = TimedHandover(
        True, StatusWriter("fake/inference"), lambda: clocks.wall_ns, lambda: clocks.mono_s
    )
    assert not standby.sends(clocks.wall_ns)
    clocks.set_moment(standby, ACT_FROM, 0)
    assert standby.sends(clocks.wall_ns)


def test_no_prediction_in_shadow_lasts_beyond_the_moment(
    clocks: Clocks, handover: TimedHandover, monkeypatch: pytest.MonkeyPatch
) -> None:
    rested_s: list[float] = []
    monkeypatch.setattr("roboneuron.switching.handover.time.sleep", rested_s.append)
    moment_ns = clocks.wall_ns + int(1.0e9)
    clocks.set_moment(handover, ACT_FROM, moment_ns)
    handover.rest()
    assert not rested_s, "how long a prediction takes is not known yet"
    clocks.mono_s += 0.3
    handover.withhold(ActionChunk(actions=np.zeros((8, 7)), step_s=0.05))
    clocks.wall_ns = moment_ns - int(0.4e9)
    handover.rest()
    assert not rested_s, "this one ends before the moment"
    assert handover.not_before_ns == 0
    clocks.wall_ns = moment_ns - int(0.2e9)
    handover.rest()
    assert rested_s == [pytest.approx(0.2)]
    assert handover.not_before_ns == moment_ns
    clocks.wall_ns = moment_ns
    handover.rest()
    assert handover.not_before_ns == moment_ns
    clocks.set_moment(handover, ACT_FROM, NEVER_NS)
    handover.rest()
    assert len(rested_s) == 1
    assert handover.not_before_ns == 0, "the handover was undone"


def test_what_was_captured_before_a_moment_is_not_left_out_for_ever(
    clocks: Clocks, handover: TimedHandover, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("roboneuron.switching.handover.time.sleep", lambda seconds: None)
    clocks.set_moment(handover, ACT_FROM, clocks.wall_ns + 10**8)
    clocks.mono_s += 0.3
    handover.withhold(ActionChunk(actions=np.zeros((8, 7)), step_s=0.05))
    handover.rest()
    assert handover.not_before_ns == clocks.wall_ns + 10**8
    clocks.wall_ns -= HOUR_NS
    clocks.mono_s += 10.0
    handover.rest()
    assert handover.not_before_ns == 0


@pytest.mark.parametrize(("period_s", "silent_s"), [(0.0, 0.1), (0.2, 0.3)])
def test_a_successor_plays_early_when_its_predecessor_has_nothing_left(
    clocks: Clocks, handover: TimedHandover, period_s: float, silent_s: float
) -> None:
    handover.period_s = lambda: period_s
    clocks.set_moment(handover, PLAY_FROM, clocks.wall_ns + 10**9)
    assert handover.may_play(clocks.wall_ns), "it was never heard"
    handover.hear_action()
    clocks.mono_s += silent_s - 0.01
    assert not handover.may_play(clocks.wall_ns)
    clocks.mono_s += 0.02
    assert handover.may_play(clocks.wall_ns)
