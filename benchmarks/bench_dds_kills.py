"""What the repair of Fast DDS shared memory is worth: kills of modules with it, with the removal of
files alone, and without it.

    python benchmarks/bench_dds_kills.py [--kills 50] [--rate-hz 100] [--json out.json]

An arm swings. Each trial kills one module other than the robot (SIGKILL) and starts it again.
"Silence" is the longest time in which the robot's joint states did not reach this process, from
the kill until the arm moves again; "back" is the time from the start of the new module until the
arm moves. A trial whose arm does not move within 30 s counts as lost, and the cell is built anew;
so does one in which this process itself hangs, which is ended then. The variants take turns.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from unittest import mock

import fault_loop
import numpy as np
import shared_memory
from bench_faults import Bench, NotSeen
from plugin_site import chunks
from rich.console import Console
from rich.table import Table

from rn_standard.fastdds import feature, processes
from roboneuron.errors import RoboNeuronError
from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.supervisor import Supervisor

KILLED: tuple[ModuleKind, ...] = ("inference", "perception", "control")
BEGIN_S, TRIAL_S = 120.0, 25.0
"""Longest start of a cell and longest trial on a loaded machine."""
VARIANTS = ("repair", "files alone", "nothing")


@dataclass
class Results:
    """Times of one variant [s], and what went wrong."""

    silence_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


@contextmanager
def _nothing(_: Supervisor) -> Iterator[None]:
    yield


class _NoPorts:
    """In place of silenced ports."""

    def __init__(self, names: object) -> None:
        pass

    def retire(self) -> None:
        """There is nothing to close."""


class _NoWatch:
    """In place of the watch of lost ports."""

    def start(self) -> None:
        """There is nothing to watch."""

    close = start


@contextmanager
def variant_of(name: str) -> Iterator[None]:
    """Build cells with as much of the repair as the variant has."""
    with ExitStack() as stack:
        patch = mock.patch.object
        if name == "nothing":
            stack.enter_context(patch(fault_loop, "repaired", _nothing))
        elif name == "files alone":
            stack.enter_context(patch(processes, "release_dead_locks", lambda: 0))
            stack.enter_context(patch(processes, "SilentPorts", _NoPorts))
            stack.enter_context(patch(feature, "PortWatch", _NoWatch))
            stack.enter_context(patch(shared_memory, "FEATURE", mock.Mock(on_join=None)))
        yield


def longest_gap_s(times: list[float]) -> float:
    """The longest time between two of them."""
    return max((b - a for a, b in itertools.pairwise(times)), default=0.0)


def try_once(bench: Bench, kind: ModuleKind, results: Results) -> None:
    """Kill a module, start it again, and note the times."""
    bench.ready()
    process = bench.loop.modules.view(kind).process
    assert process is not None
    at_s = time.monotonic()
    os.kill(process.pid, signal.SIGKILL)
    bench.noticed_s(kind, "exited", at_s)
    started_s = time.monotonic()
    bench.restart(kind)
    bench.ready()
    now_s = time.monotonic()
    results.back_s.append(now_s - started_s)
    times = [t for t, _ in bench.witness.joints() if t >= at_s]
    results.silence_s.append(longest_gap_s([at_s, *times, now_s]))


def run(name: str, results: Results, kills: int, rate_hz: float) -> None:
    """Kill modules of one cell of this variant, up to the first lost trial."""
    with (
        tempfile.TemporaryDirectory() as scratch,
        variant_of(name),
        fault_loop.moving_cell(
            Path(scratch), rate_hz, backend="steady", policy=chunks(1, 0.0, rate_hz)
        ) as (loop, witness),
    ):
        bench = Bench(loop, witness)
        try:
            for trial in range(kills):
                kind = KILLED[trial % len(KILLED)]
                try:
                    try_once(bench, kind, results)
                except (NotSeen, RoboNeuronError) as error:
                    results.lost.append(f"{kind}: {str(error)[:200]}")
                    break
                print(json.dumps(asdict(results)), flush=True)
        finally:
            bench.close()


def take_turn(name: str, results: Results, kills: int, rate_hz: float) -> None:
    """Kill modules in processes of their own, one for each cell."""
    while kills > 0:
        command = [sys.executable, __file__, "--cell", name, "--kills", str(kills)]
        command += ["--rate-hz", str(rate_hz)]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
        hung = ""
        try:
            out, _ = child.communicate(timeout=BEGIN_S + kills * TRIAL_S)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            out, _ = child.communicate(timeout=10.0)
            hung = "the process of the server hung"
        lines = [line for line in out.splitlines() if line.startswith("{")]
        cell = Results(**json.loads(lines[-1])) if lines else Results()
        results.silence_s += cell.silence_s
        results.back_s += cell.back_s
        lost = cell.lost or ([hung] if hung or not cell.back_s else [])
        results.lost += lost
        kills -= len(cell.back_s) + len(lost)


def main() -> int:
    """Run every variant in turn and print one table; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50, help="of each variant")
    parser.add_argument("--turn", type=int, default=10, help="kills of a variant's turn")
    parser.add_argument("--rate-hz", type=float, default=100.0, help="of images and actions")
    parser.add_argument("--json", type=Path, help="write the raw seconds here")
    parser.add_argument("--cell", choices=VARIANTS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.cell is not None:
        result = Results()
        run(arguments.cell, result, arguments.kills, arguments.rate_hz)
        print(json.dumps(asdict(result)), flush=True)
        return 0
    results = {name: Results() for name in VARIANTS}
    for first in range(0, arguments.kills, arguments.turn):
        for name, result in results.items():
            take_turn(name, result, min(arguments.turn, arguments.kills - first), arguments.rate_hz)
            if arguments.json:
                text = json.dumps({name: asdict(result) for name, result in results.items()})
                arguments.json.write_text(text)
    table = Table(title=f"{arguments.kills} kills of each variant")
    for head in (
        *("variant", "silence: median, p95, longest [s]", "silent > 1 s"),
        *("back: median, p95, longest [s]", "lost"),
    ):
        table.add_column(head)
    for name, result in results.items():
        table.add_row(
            name,
            _quantiles(result.silence_s),
            str(sum(value > 1.0 for value in result.silence_s)),
            _quantiles(result.back_s),
            str(len(result.lost)),
        )
    Console(width=130).print(table)
    for name, result in results.items():
        for reason in result.lost:
            print(f"{name}: {reason}")
    return 0


def _quantiles(values: list[float]) -> str:
    return " ".join(f"{value:.2f}" for value in np.percentile(values or [0.0], [50, 95, 100]))


if __name__ == "__main__":
    sys.exit(main())
