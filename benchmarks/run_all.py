"""Run every benchmark of the closed loop in turn and repeat all failures at the end.

    python benchmarks/run_all.py [--quick] [--only bench_ik bench_loop]

A benchmark that takes longer than its bound is ended with all processes of its session. A line
"missed: ..." of a benchmark reports a missed time limit: on a loaded machine that means little, so
it is repeated at the end but is not a failure. Exit status 1 when a benchmark failed or was ended,
0 otherwise. `--quick` makes each as short as possible.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
MISSED = "missed: "
"""Start of a line by which a benchmark reports a missed time limit."""
ENDING_S = 20.0
"""Time for a benchmark to end by itself at its bound, before it is killed."""
KILLED_S = 60.0
"""Time for the kernel to end a killed process."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Benchmark:
    """One command.

    Attributes:
        script: its name without `.py`.
        arguments: always passed.
        quick: further arguments of a run that only shows that the benchmark works.
        bound_s: time limit: several times its usual time on a loaded machine.
    """

    script: str
    arguments: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()
    bound_s: float = 1800.0

    @property
    def title(self) -> str:
        """The command as typed in a terminal, without `python`."""
        return " ".join((f"{self.script}.py", *self.arguments))

    def command(self, is_quick: bool) -> list[str]:
        """Command line of the process."""
        return [
            sys.executable,
            str(HERE / f"{self.script}.py"),
            *self.arguments,
            *(self.quick if is_quick else ()),
        ]


BENCHMARKS = (
    Benchmark(script="guard", quick=("--rounds", "1")),
    Benchmark(script="bench_plugins_list", quick=("--repeat", "3")),
    Benchmark(script="bench_ik", quick=("--targets", "50")),
    Benchmark(script="bench_loop", quick=("--frames", "60", "--rounds", "1")),
    Benchmark(
        script="bench_execution",
        quick=("--seeds", "1", "--duration", "5"),
    ),
    Benchmark(script="bench_start_stop", quick=("--cycles", "2")),
    Benchmark(
        script="bench_switch",
        quick=("--switches", "2", "--cold", "1", "--rates", "10"),
        bound_s=3 * 3600.0,
    ),
    Benchmark(script="bench_faults", quick=("--trials", "2"), bound_s=4 * 3600.0),
    Benchmark(
        script="bench_direct",
        quick=("--calls", "20", "--stops", "3", "--starts", "1", "--sizes", "3"),
    ),
    Benchmark(script="bench_servo", quick=("--seeds", "2"), bound_s=3600.0),
    Benchmark(
        script="bench_servo",
        arguments=("--added-latency-ms", "300"),
        quick=("--seeds", "2"),
        bound_s=3600.0,
    ),
    Benchmark(script="bench_interfaces", quick=("--rounds", "3")),
    Benchmark(script="bench_view", quick=("--seconds", "5")),
    Benchmark(script="bench_lead", quick=("--quick",)),
    Benchmark(script="bench_full_ports", quick=("--trials", "3")),
)


@dataclass(kw_only=True, slots=True)
class Ending:
    """How a benchmark ended.

    Attributes:
        title: its command.
        failure: why it failed; empty when it did not.
        missed: time limits that it missed.
        took_s: how long it ran.
    """

    title: str
    failure: str = ""
    missed: list[str] = field(default_factory=list)
    took_s: float = 0.0


def run(title: str, command: Sequence[str], bound_s: float) -> Ending:
    """Run one command until it ends or reaches its bound, and relay its output."""
    ending = Ending(title=title)
    begun_s = time.monotonic()
    wide = {"COLUMNS": str(shutil.get_terminal_size((150, 24)).columns), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        errors="replace",
        env=os.environ | wide,
        start_new_session=True,
    )

    def relay() -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                print(line, end="", flush=True)
                if line.startswith(MISSED):
                    ending.missed.append(line.removeprefix(MISSED).strip())

    reader = threading.Thread(target=relay, daemon=True)
    reader.start()
    try:
        status = process.wait(bound_s)
        if status:
            ending.failure = f"exit status {status}"
    except subprocess.TimeoutExpired:
        ending.failure = f"ended after {bound_s:g} s"
    finally:
        _end(process)
    reader.join(ENDING_S)  # a process that left the session may keep the pipe open
    ending.took_s = time.monotonic() - begun_s
    return ending


def _end(process: subprocess.Popen[str]) -> None:
    """End the remaining processes of the session: SIGINT first, then SIGKILL."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(ENDING_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(KILLED_S)


def report(endings: Sequence[Ending]) -> int:
    """Print how each benchmark ended; returns the exit status."""
    print(
        f"\n{len(endings)} benchmarks, load now {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
    for ending in endings:
        word = f"FAILED, {ending.failure}" if ending.failure else "done"
        print(f"  {ending.title:<48} {ending.took_s:6.0f} s  {word}")
        for missed in ending.missed:
            print(f"    {MISSED}{missed}")
    return 1 if any(ending.failure for ending in endings) else 0


def main() -> int:
    """Run the benchmarks and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="as short as possible: only checks that all of them work",
    )
    parser.add_argument(
        "--only", nargs="+", choices=sorted({b.script for b in BENCHMARKS}), help="run only these"
    )
    arguments = parser.parse_args()
    endings = []
    for benchmark in BENCHMARKS:
        if arguments.only and benchmark.script not in arguments.only:
            continue
        print(f"\n== {benchmark.title}", flush=True)
        endings.append(run(benchmark.title, benchmark.command(arguments.quick), benchmark.bound_s))
    return report(endings)


if __name__ == "__main__":
    sys.exit(main())
