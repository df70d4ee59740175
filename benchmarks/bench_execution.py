"""Chunks executed in real time: the fraction of its rate that a policy with late answers keeps, for
each mode.

    python benchmarks/bench_execution.py [--seconds 12]
    python benchmarks/bench_execution.py --virtual [--seeds 3] [--duration 45]

The policy follows a target that circles in either direction, so that two chunks disagree; rows are
50 ms long.

Without --virtual RoboNeuron's inference module runs in its process, the benchmark simulates its
camera and arm, and the policy sleeps for its latency (lognormal, 20 %). The modes of each case are
interleaved, next to the same trial with the virtual clock. Rate, starved periods and longest gap
are those of the action topic; jumps come from the status. "Late ticks" are those of a thread that
only sleeps 50 ms at a time: ticks that are half a period late are caused by the machine, and so is
about that number of starved periods.

With --virtual the executor runs with a virtual clock, without processes: the table of
docs/benchmarks.md. "sequential" is the baseline in both tables; the ideal is the rate of the
chunks, 20 Hz.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_loop import inference
from execution_cell import Cell, Measured
from plugin_site import installed
from rich.console import Console
from rich.table import Table

from rn_standard.execution.mode import Abilities, Mode
from rn_standard.execution.virtual_cell import Outcomes, Trial, run
from roboneuron.ros.environment import prepare_environment

HORIZONS = (8, 16)
LATENCIES_MS = (50.0, 112.0, 250.0, 340.0, 600.0)
REAL_LATENCIES_MS = (112.0, 250.0)
WARM_UP_S = 3.0
MAX_IMAGE_AGE_S = 2.0


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
REAL_WAYS = WAYS[:3]


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


def measure(
    horizon: int, latency_ms: float, way: Way, cell: Cell, folder: Path, seconds: float
) -> Measured:
    """Run RoboNeuron's inference module on one case."""
    backend = "late-rtc" if way.abilities.conditions_on_rows else "late"
    configuration = (
        '[robot]\nname = "bench"\n'
        f'[inference]\nbackend = "{backend}"\ninstruction = "go"\nexecution = '
        f'"{way.mode or "auto"}"\n'
        f"max_image_age_s = {MAX_IMAGE_AGE_S}\n"
        f"[plugins.{backend}]\nrows = {horizon}\nlatency_ms = {latency_ms}\n"
        f"conditions_on_rows = {str(way.abilities.conditions_on_rows).lower()}\n"
    )
    with inference(dict(os.environ), folder, configuration):
        cell.wait_for_peer()
        measured = cell.measure(WARM_UP_S, seconds)
    cell.wait_until_alone()
    return measured


def real_cells(measured: Measured, seconds: float) -> list[str]:
    """As `virtual_cells`; the error is not measured."""
    border_mm, inner_mm = (
        float(measured.status.get(f"{name}_jump_mm", "nan")) for name in ("border", "inner")
    )
    return [
        f"{measured.rate:.1%}",
        f"{measured.starved_periods * 60 / seconds:.0f}",
        f"{measured.longest_gap_s * 1e3:.0f}",
        f"{border_mm:.1f} / {inner_mm:.1f}",
        f"{border_mm / inner_mm:.1f}",
    ]


def real_table(seconds: float, folder: Path) -> Table:
    """Real processes, each case next to the same one with the virtual clock."""
    table = Table(
        title=f"Real processes, {seconds:g} s each, rows of 50 ms, latency with 20 % jitter"
    )
    for column in (
        "rows",
        "latency ms",
        "mode",
        "clock",
        "rate",
        "starved / min",
        "longest gap ms",
        "border / inner jump mm",
        "ratio",
        "capture to answer p50 / p99 ms",
        "late ticks / min",
        "load",
    ):
        table.add_column(column, justify="right")
    with installed(folder, "execution-plugin", ("execution_plugin",)):
        prepare_environment(folder / "log")
        cell = Cell()
        try:
            for horizon in HORIZONS:
                for latency_ms in REAL_LATENCIES_MS:
                    for way in REAL_WAYS:
                        measured = measure(horizon, latency_ms, way, cell, folder, seconds)
                        status = measured.status
                        latency = " / ".join(
                            f"{float(status[f'latency_{p}_ms']):.0f}" for p in ("p50", "p99")
                        )
                        name = chosen(way, status["mode"])
                        case = (str(horizon), f"{latency_ms:g}", name)
                        load, late = os.getloadavg()[0], f"{measured.late_ticks * 60 / seconds:.0f}"
                        table.add_row(
                            *case,
                            "real",
                            *real_cells(measured, seconds),
                            latency,
                            late,
                            f"{load:.1f}",
                        )
                        trials = virtual_trials(
                            horizon, latency_ms, way, seeds=1, duration_s=seconds
                        )
                        table.add_row(
                            "", "", "", "virtual", *virtual_cells(trials, seconds)[:5], "", "", ""
                        )
                    table.add_section()
        finally:
            cell.close()
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--virtual", action="store_true", help="by a virtual clock only, without processes"
    )
    parser.add_argument("--seeds", type=int, default=3, help="virtual runs per row (default 3)")
    parser.add_argument(
        "--duration", type=float, default=45.0, help="simulated seconds per run (default 45)"
    )
    parser.add_argument(
        "--seconds", type=float, default=12.0, help="measured seconds per real case (default 12)"
    )
    arguments = parser.parse_args()
    console = Console(width=150)
    if arguments.virtual:
        console.print(virtual_table(arguments.seeds, arguments.duration))
        return
    with tempfile.TemporaryDirectory() as directory:
        console.print(real_table(arguments.seconds, Path(directory)))


if __name__ == "__main__":
    main()
