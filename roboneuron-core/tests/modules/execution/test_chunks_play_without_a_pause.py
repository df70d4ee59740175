"""Chunk execution by a virtual clock; the table: `python benchmarks/bench_execution.py`."""

from __future__ import annotations

import pytest
from virtual_cell import Trial, run

from roboneuron.modules.execution.mode import Abilities

CONDITIONED = Abilities(conditions_on_rows=True)
IN_TIME = [(8, 0.05), (8, 0.112), (16, 0.05), (16, 0.112), (16, 0.25)]
"""Rows and latency [s] with 2 d99 + 1 <= H."""
BEYOND = [(8, 0.25), (8, 0.34), (16, 0.34), (16, 0.6)]


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("abilities", [Abilities(), CONDITIONED], ids=["fade", "rtc"])
@pytest.mark.parametrize(("horizon", "latency_s"), IN_TIME)
def test_the_arm_never_waits_for_the_model(
    horizon: int, latency_s: float, abilities: Abilities
) -> None:
    result = run(Trial(horizon=horizon, latency_s=latency_s, abilities=abilities, duration_s=20.0))
    assert result.mode == ("rtc" if abilities.conditions_on_rows else "overlap")
    assert result.rate >= 0.99
    assert result.delivery.starved_periods == 0
    assert result.delivery.border_jump_mm is not None
    assert result.delivery.inner_jump_mm is not None
    assert result.delivery.border_jump_mm <= 1.5 * result.delivery.inner_jump_mm
    assert set(result.outcomes) == {"accepted"}


@pytest.mark.parametrize(("horizon", "latency_s"), BEYOND)
def test_beyond_that_it_pauses_less_than_sequential_execution(
    horizon: int, latency_s: float
) -> None:
    overlapped = run(Trial(horizon=horizon, latency_s=latency_s, duration_s=20.0))
    sequential = run(
        Trial(horizon=horizon, latency_s=latency_s, mode="sequential", duration_s=20.0)
    )
    assert overlapped.mode == "overlap"
    assert overlapped.rate > sequential.rate


def test_an_answer_longer_than_a_chunk_is_executed_sequentially() -> None:
    assert run(Trial(horizon=8, latency_s=0.6, duration_s=20.0)).mode == "sequential"


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize(("horizon", "latency_s"), [*IN_TIME, *BEYOND])
@pytest.mark.parametrize(
    "abilities", [Abilities(), Abilities(takes_predicted_state=True)], ids=["fade", "predicted"]
)
def test_no_row_is_sent_twice_or_out_of_order(
    horizon: int, latency_s: float, abilities: Abilities
) -> None:
    played = run(
        Trial(horizon=horizon, latency_s=latency_s, abilities=abilities, duration_s=10.0)
    ).played
    assert len(set(played)) == len(played)
    assert played == sorted(played)


def test_a_rolled_state_plays_whole_chunks_without_a_gap() -> None:
    able = Abilities(takes_predicted_state=True)
    result = run(Trial(horizon=16, latency_s=0.34, abilities=able, duration_s=20.0))
    assert result.mode == "predicted-state"
    assert result.rate >= 0.99
    rows = [row for _, row in result.played]
    assert rows[-32:-16] == sorted(rows[-32:-16]) or 0 in rows[-32:-16]
    assert set(rows) == set(range(16))


def test_the_same_trial_gives_the_same_rows() -> None:
    assert run(Trial(duration_s=5.0)).played == run(Trial(duration_s=5.0)).played
