"""Run the loop for half an hour: 30 Hz, 640x480, a switch of the backend every minute, a random
fault every two minutes.

    python benchmarks/soak.py [--minutes 30] [--switch-s 60] [--fault-s 120] [--json out.json]

With --rows 16 --delay-ms 100 the backends answer with chunks, which are executed as `auto` decides.
A real server runs over stdio, as an agent's client would start it; this process is the agent.
Memory (resident without shared), open handles and threads of every process and Fast DDS's files in
shared memory are sampled, and a line is fitted through the samples after the warm-up. The run fails
when a quantity grows by more than `GROWTH` over that time, when the loop does not recover from a
fault as configured, or when a switch takes too long.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from plugin_site import chunks
from rich.console import Console
from rich.table import Table
from soak_cell import served_cell, until

GROWTH = {"memory_mb": 8.0, "handles": 6.0, "threads": 4.0, "shm_files": 12.0, "shm_mb": 40.0}
"""Largest allowed growth of each quantity after the warm-up, by the fitted line; noise of one
minute stays below it.
"""
MOVES_AGAIN_S = 30.0
"""Time within which a restarted module makes the arm move again, on a busy machine."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """Settings of a soak; times in seconds."""

    duration_s: float = 1800.0
    switch_s: float = 60.0
    fault_s: float = 120.0
    sample_s: float = 5.0
    warm_up_s: float = 120.0
    rate_hz: float = 30.0
    width: int = 640
    height: int = 480
    seed: int = 1
    rows: int = 1
    delay_ms: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """One fault or switch: when, what, whether it went as configured, and how long that took."""

    at_s: float
    what: str
    ok: bool
    took_s: float
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Trend:
    """One quantity of one process.

    Attributes:
        first, last: medians of the first and last tenth after the warm-up.
        growth: increase of the fitted line over that time.
        limit: largest allowed growth.
    """

    process: str
    quantity: str
    first: float
    last: float
    growth: float
    limit: float

    @property
    def ok(self) -> bool:
        """Whether the growth is within its limit."""
        return self.growth <= self.limit


@dataclass(kw_only=True, slots=True)
class Report:
    """Results of a soak."""

    seconds: float = 0.0
    actions: int = 0
    outcomes: list[Outcome] = field(default_factory=list)
    trends: list[Trend] = field(default_factory=list)

    @property
    def problems(self) -> list[str]:
        """Why it failed; empty when it did not."""
        bad = [f"{o.what} at {o.at_s:.0f} s: {o.note}" for o in self.outcomes if not o.ok]
        return bad + [
            f"{t.quantity} of {t.process} grew by {t.growth:.1f} from {t.first:.1f}, at most "
            f"{t.limit:g}"
            for t in self.trends
            if not t.ok
        ]


def judge(
    samples: list[tuple[float, dict[tuple[str, str], float]]], warm_up_s: float
) -> list[Trend]:
    """Fit a line through each quantity after the warm-up."""
    kept = [(at_s, found) for at_s, found in samples if at_s >= warm_up_s]
    trends = []
    for key in sorted({key for _, found in kept for key in found}):
        at = np.array([at_s for at_s, found in kept if key in found])
        values = np.array([found[key] for _, found in kept if key in found])
        if len(at) < 5:
            continue
        slope = float(np.polyfit(at, values, 1)[0])
        tenth = max(1, len(at) // 10)
        trends.append(
            Trend(
                process=key[0],
                quantity=key[1],
                first=float(np.median(values[:tenth])),
                last=float(np.median(values[-tenth:])),
                growth=slope * float(at[-1] - at[0]),
                limit=GROWTH[key[1]],
            )
        )
    return trends


def run(settings: Settings, folder: Path, tell: Callable[[str], None]) -> Report:
    """Soak a loop; `tell` is called with a line about every switch and fault."""
    report = Report()
    chance = random.Random(settings.seed)
    policy = chunks(settings.rows, settings.delay_ms, settings.rate_hz)
    with served_cell(folder, settings.rate_hz, (settings.width, settings.height), policy) as cell:
        cell.start()
        started_s = time.monotonic()
        samples: list[tuple[float, dict[tuple[str, str], float]]] = []
        names: list[str] = []
        next_sample, next_switch, next_fault = 0.0, settings.switch_s, settings.fault_s

        def note(what: str, work: Callable[[], str | None]) -> None:
            at_s = time.monotonic() - started_s
            begun_s = time.monotonic()
            try:
                said = work() or ""
                cell.swing()
                until(cell.is_well, MOVES_AGAIN_S, "everything works again")
                ok = True
            except RuntimeError as error:
                said, ok = f"{error}; {cell.agent.modules()}", False
            took_s = time.monotonic() - begun_s
            report.outcomes.append(Outcome(at_s=at_s, what=what, ok=ok, took_s=took_s, note=said))
            tell(
                f"{at_s:6.0f} s  {what}: {'well' if ok else 'FAILED'} after {took_s:.1f} s "
                f"{said if ok else said[:300]}"
            )

        while (now_s := time.monotonic() - started_s) < settings.duration_s:
            if now_s >= next_sample:
                next_sample += settings.sample_s
                samples.append((now_s, cell.sample()))
            elif now_s >= next_switch:
                next_switch += settings.switch_s
                note("switch", cell.switch)
            elif now_s >= next_fault:
                next_fault += settings.fault_s
                faults = cell.faults()
                if not names:
                    names = chance.sample(sorted(faults), len(faults))
                name = names.pop()
                note(name, faults[name])
            else:
                time.sleep(0.1)
        report.seconds = time.monotonic() - started_s
        report.actions = cell.witness.actions()
        report.trends = judge(samples, min(settings.warm_up_s, settings.duration_s / 3))
    return report


def main() -> None:
    """Soak, print the tables, and fail when a quantity grew or the loop did not recover."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="duration")
    parser.add_argument(
        "--switch-s", type=float, default=60.0, metavar="S", help="time between two switches"
    )
    parser.add_argument(
        "--fault-s", type=float, default=120.0, metavar="S", help="time between two faults"
    )
    parser.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="images per second")
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        default=[640, 480],
        metavar=("W", "H"),
        help="image size in pixels",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the order of the faults")
    parser.add_argument(
        "--rows", type=int, default=1, metavar="N", help="actions per chunk, one per period"
    )
    parser.add_argument(
        "--delay-ms", type=float, default=0.0, metavar="MS", help="duration of a prediction"
    )
    parser.add_argument("--json", type=Path, help="write all results to this file")
    arguments = parser.parse_args()
    settings = Settings(
        duration_s=arguments.minutes * 60,
        switch_s=arguments.switch_s,
        fault_s=arguments.fault_s,
        rate_hz=arguments.rate,
        width=arguments.size[0],
        height=arguments.size[1],
        seed=arguments.seed,
        rows=arguments.rows,
        delay_ms=arguments.delay_ms,
    )
    console = Console(width=150)
    with tempfile.TemporaryDirectory() as folder:
        report = run(settings, Path(folder), lambda text: console.print(text, highlight=False))
    table = Table(
        title=f"After {report.seconds:.0f} s, {report.actions} actions, {len(report.outcomes)} "
        "switches and faults"
    )
    for head in (
        "process",
        "quantity",
        "first tenth",
        "last tenth",
        "growth by the fitted line",
        "allowed",
    ):
        table.add_column(head)
    for t in report.trends:
        mark = "" if t.ok else "  GROWS"
        table.add_row(
            t.process,
            t.quantity,
            f"{t.first:.1f}",
            f"{t.last:.1f}",
            f"{t.growth:+.2f}{mark}",
            f"{t.limit:g}",
        )
    console.print(table)
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"settings": asdict(settings), **asdict(report)}, indent=1)
        )
    for problem in report.problems:
        console.print(f"FAILED: {problem}", highlight=False)
    sys.exit(1 if report.problems else 0)


if __name__ == "__main__":
    main()
