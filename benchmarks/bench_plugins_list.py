"""Time of `roboneuron plugins list` with all installed packages, compared with the bare
interpreter.

    python benchmarks/bench_plugins_list.py [--repeat 15]

The floor is `python -c pass` of the same interpreter; the commands are interleaved, so that other
load on the machine affects all of them; processor time excludes that load. A median wall time of
400 ms or more is reported as missed; the exit status is 1 if one of numpy, torch, rclpy, mcp and
pydantic is imported.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time

from rich.console import Console
from rich.table import Table

LIMIT_MS = 400.0
HEAVY = ("numpy", "torch", "rclpy", "mcp", "pydantic")
LIST = "from roboneuron.cli.main import main; main(['plugins', 'list'{flag}])"
COMMANDS = {
    "python -c pass": [sys.executable, "-c", "pass"],
    "roboneuron plugins list --json": [sys.executable, "-c", LIST.format(flag=", '--json'")],
    "roboneuron plugins list": [sys.executable, "-c", LIST.format(flag="")],
}
PROBE = (
    f"import sys; {LIST.format(flag='')}; print([m for m in {HEAVY!r} if m in sys.modules], "
    "file=sys.stderr)"
)


def run_ms(command: list[str]) -> tuple[float, float]:
    """Wall and processor time of one run [ms]."""
    before_s, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)
    wall_s, after = time.perf_counter() - before_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
    return wall_s * 1000, processor_s * 1000


def main() -> int:
    """Measure, print the table and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=15, help="runs of each command (15)")
    repeat = parser.parse_args().repeat
    for command in COMMANDS.values():
        run_ms(command)  # warms byte code and page cache
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    for _ in range(repeat):
        for name, command in COMMANDS.items():
            times[name].append(run_ms(command))
    medians = {
        name: statistics.median(wall for wall, _ in values) for name, values in times.items()
    }
    processor = {
        name: statistics.median(cpu for _, cpu in values) for name, values in times.items()
    }
    floor_ms = medians["python -c pass"]
    listing = subprocess.run(
        COMMANDS["roboneuron plugins list --json"],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    plugins = json.loads(listing.stdout)["plugins"]
    probe = subprocess.run(
        [sys.executable, "-c", PROBE], check=True, capture_output=True, text=True, timeout=60
    )
    heavy = probe.stderr.strip().splitlines()[-1]
    offers = sum(len(plugin["offers"]) for plugin in plugins)

    table = Table(title=f"{len(plugins)} plugins with {offers} offers, {repeat} runs each")
    for column in ("command", "median [ms]", "fastest [ms]", "ratio to floor", "processor [ms]"):
        table.add_column(column, justify="left" if column == "command" else "right")
    for name, median_ms in medians.items():
        fastest_ms = min(wall for wall, _ in times[name])
        ratio = f"{median_ms / floor_ms:.1f}"
        table.add_row(
            name, f"{median_ms:.0f}", f"{fastest_ms:.0f}", ratio, f"{processor[name]:.0f}"
        )
    console = Console()
    console.print(table)
    console.print(f"limit {LIMIT_MS:.0f} ms; heavy modules imported: {heavy}")
    if (median_ms := medians["roboneuron plugins list"]) >= LIMIT_MS:
        print(
            f"missed: roboneuron plugins list took {median_ms:.0f} ms, expected less than "
            f"{LIMIT_MS:.0f} ms"
        )
    return 0 if heavy == "[]" else 1


if __name__ == "__main__":
    sys.exit(main())
