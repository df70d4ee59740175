"""Stepped time passes as commands last, not as they come."""

from __future__ import annotations

from rn_simulation.stepped import ALONE_S, PATIENCE_S, SETTLE_S, SteppedTime, TurnWord, WorldPhase

STEP_S = 1 / 240
SETTLING = round(SETTLE_S / STEP_S)


def run(stepped: SteppedTime, now_s: float = 0.0, due: int = 7) -> int:
    """Make steps until it stands; returns how many."""
    made = 0
    while not stepped.stands:
        made += stepped.grant(due, now_s, round(now_s * 1e9))
        stepped.note_made(now_s, round(now_s * 1e9))
    return made


def rested() -> SteppedTime:
    stepped = SteppedTime(STEP_S)
    assert run(stepped) == SETTLING
    assert stepped.phase is WorldPhase.RESTING
    return stepped


def test_it_begins_by_settling_and_then_rests_for_ever():
    stepped = rested()
    assert stepped.grant(1000, 1e6, 10**15) == 0
    assert stepped.phase is WorldPhase.RESTING
    assert stepped.count == 0


def test_a_command_lasts_as_long_as_it_says_whatever_the_wall_clock_does():
    for due in (1, 5, 1000):
        stepped = rested()
        stepped.command(0.1, 0)
        assert run(stepped, 1.0, due) == 24
        assert (stepped.phase, stepped.count) == (WorldPhase.WAITING, 1)
        assert stepped.grant(1000, 1.0 + 0.9 * PATIENCE_S, 0) == 0


def test_a_newer_command_replaces_the_rest_of_the_one_before():
    stepped = rested()
    stepped.command(0.1, 0)
    assert stepped.grant(10, 0.0, 0) == 10
    stepped.note_made(0.0, 0)
    stepped.command(0.05, 0)
    assert run(stepped) == 12
    assert stepped.count == 1


def test_it_settles_when_no_command_comes():
    stepped = rested()
    stepped.command(0.1, 0)
    run(stepped, 1.0)
    stepped.note_made(1.0, 0)
    now_s = 1.01 + PATIENCE_S
    assert stepped.grant(5, now_s, 7) == 5
    assert (stepped.phase, stepped.since_ns) == (WorldPhase.SETTLING, 7)
    assert run(stepped, now_s) == SETTLING - 5
    assert (stepped.phase, stepped.count) == (WorldPhase.RESTING, 1)


def test_a_hold_settles_at_once_and_moves_no_time_at_rest():
    stepped = rested()
    stepped.settle(5)
    assert stepped.phase is WorldPhase.RESTING
    stepped.command(0.1, 6)
    stepped.settle(7)
    assert stepped.phase is WorldPhase.SETTLING


def test_it_settles_when_it_is_told_that_nothing_follows():
    stepped = rested()
    stepped.command(0.1, 0)
    stepped.take_turn(TurnWord.ENDED, 0, 5)
    assert stepped.phase is WorldPhase.MOVING
    run(stepped)
    stepped.take_turn(TurnWord.ENDED, 0, 6)
    assert stepped.phase is WorldPhase.WAITING  # told of an earlier command
    stepped.take_turn(TurnWord.ENDED, 1, 7)
    assert (stepped.phase, stepped.since_ns) == (WorldPhase.SETTLING, 7)
    assert run(stepped) == SETTLING
    assert (stepped.phase, stepped.count) == (WorldPhase.RESTING, 1)


def test_an_action_that_moves_nothing_counts_without_time():
    stepped = rested()
    stepped.take_turn(TurnWord.SKIPPED, 0, 9)
    assert (stepped.phase, stepped.count, stepped.since_ns) == (WorldPhase.RESTING, 1, 9)
    assert stepped.grant(100, 0.0, 0) == 0


def test_a_long_command_is_no_part_of_a_sequence():
    stepped = rested()
    stepped.command(ALONE_S, 0)
    assert run(stepped) == round(ALONE_S / STEP_S) + SETTLING
    assert (stepped.phase, stepped.count) == (WorldPhase.RESTING, 1)
