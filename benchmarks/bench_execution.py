"""Chunks executed with a virtual clock: the fraction of its rate that a policy with late answers
keeps, for each mode.

    python benchmarks/bench_execution.py [--seeds 3] [--duration 45]

The policy follows a target that circles in either direction, so that two chunks disagree; rows are
50 ms long.

The executor runs with a virtual clock, without processes. "sequential" is the baseline; the ideal
is the rate of the chunks, 20 Hz.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table
from virtual_cell import Outcomes, Trial, run

from roboneuron.modules.execution.mode import Abilities, Mode

HORIZONS = (8, 16)
LATENCIES_MS = (50.0, 112.0, 250.0, 340.0, 600.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Way:
    """Execution of chunks in one row of the table.

    Attributes:
        name: name in the table.
        mode: fixed mode; None for automatic choice.
        abilities: abilities that the policy declares.
    """

    name: str
    mode: Mode | None
    abilities: Abilities


WAYS = (
    Way(name="sequential", mode="sequential", abilities=Abilities()),
    Way(name="auto", mode=None, abilities=Abilities()),
    Way(name="rtc", mode="rtc", abilities=Abilities(conditions_on_rows=True)),
    Way(
        name="predicted-state",
        mode="predicted-state",
        abilities=Abilities(takes_predicted_state=True),
    ),
)


def virtual_trials(
    horizon: int, latency_ms: float, way: Way, *, seeds: int, duration_s: float
) -> list[Outcomes]:
    """The trials of one row."""
    return [
        run(
            Trial(
                horizon=horizon,
                latency_s=latency_ms / 1e3,
                mode=way.mode,
                abilities=way.abilities,
                duration_s=duration_s,
                seed=seed,
            )
        )
        for seed in range(seeds)
    ]


def mean(values: Iterable[float | None]) -> float:
    """Mean of the known values."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")


def chosen(way: Way, mode: str) -> str:
    """The row's name, and the chosen mode."""
    return way.name if way.mode else f"{way.name}: {mode}"


def virtual_cells(trials: list[Outcomes], duration_s: float) -> list[str]:
    """Rate, starved periods per minute, longest gap, border and inner jump, ratio, image age,
    error.
    """
    deliveries = [trial.delivery for trial in trials]
    border_mm, inner_mm = (
        mean(d.border_jump_mm for d in deliveries),
        mean(d.inner_jump_mm for d in deliveries),
    )
    return [
        f"{mean(trial.rate for trial in trials):.1%}",
        f"{mean(d.starved_periods for d in deliveries) * 60 / duration_s:.0f}",
        f"{max(d.longest_gap_s for d in deliveries) * 1e3:.0f}",
        f"{border_mm:.1f} / {inner_mm:.1f}",
        f"{border_mm / inner_mm:.1f}",
        f"{mean(trial.image_age_s for trial in trials) * 1e3:.0f}",
        f"{mean(trial.rms_error_m for trial in trials) * 1e3:.0f}",
    ]


def virtual_table(seeds: int, duration_s: float) -> Table:
    """Every horizon, latency and mode, with the virtual clock."""
    table = Table(
        title=f"Virtual clock, rows of 50 ms, latency with 20 % jitter, {seeds} runs of "
        f"{duration_s:g} s"
    )
    for column in (
        "rows",
        "latency ms",
        "mode",
        "rate",
        "starved / min",
        "longest gap ms",
        "border / inner jump mm",
        "ratio",
        "image age ms",
        "error mm",
    ):
        table.add_column(column, justify="right")
    for horizon in HORIZONS:
        for latency_ms in LATENCIES_MS:
            for way in WAYS:
                trials = virtual_trials(
                    horizon, latency_ms, way, seeds=seeds, duration_s=duration_s
                )
                cells = virtual_cells(trials, duration_s)
                table.add_row(str(horizon), f"{latency_ms:g}", chosen(way, trials[-1].mode), *cells)
            table.add_section()
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=3, help="virtual runs per row (default 3)")
    parser.add_argument(
        "--duration", type=float, default=45.0, help="simulated seconds per run (default 45)"
    )
    arguments = parser.parse_args()
    Console(width=150).print(virtual_table(arguments.seeds, arguments.duration))


if __name__ == "__main__":
    main()
