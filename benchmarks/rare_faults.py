"""Repeat under load the faults that occur once in a hundred trials or less, count them and keep
their logs.

    python benchmarks/rare_faults.py --fault client-death --trials 500 --workers 3 --load 2 --folder
    /tmp/rare

The faults: "client-death" (the client of a server is killed while a module starts: server and
modules must be gone within GONE_S), "control-restart" (control is killed while the arm moves, and
started again: the arm must move again) and "control-switch" (the controller is replaced warm while
the arm moves, at 30 Hz; a request of the server that counts as foreign is a failure too). Periods
missed at a switch are compared with periods missed elsewhere, which are due to the machine.

Results are lines in FOLDER/FAULT.jsonl: an interrupted run is resumed from them. Each trial that
failed names the folder with the logs of its cell. Every wait has a bound, and workers that exceed
their bound are ended and counted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parent))
import rare_trials

sys.path.pop(0)

BATCH = 20
"""Trials of one worker process; each worker first makes its own cell."""
TRIAL_S, CELL_S = 60.0, 120.0
"""Time limits of one trial, and of the rest of a worker."""
LOADING = "import time\nwhile True: sum(range(100000))"


@contextlib.contextmanager
def loaded(processes: int) -> Iterator[None]:
    """Run processes that use a whole core each."""
    busy = [subprocess.Popen([sys.executable, "-S", "-c", LOADING]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait(10)


class Results:
    """Outcome of each trial, in a file that the next run reads; usable from any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.all: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def add(self, result: Mapping[str, Any]) -> None:
        """Append one result."""
        with self._lock, self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result) + "\n")
            self.all.append(dict(result))


class Shares:
    """Number of trials not yet given to workers; usable from any thread."""

    def __init__(self, trials: int) -> None:
        self._left = max(0, trials)
        self._lock = threading.Lock()

    def take(self) -> int:
        """Take at most BATCH trials; 0 when none is left."""
        with self._lock:
            share = min(BATCH, self._left)
            self._left -= share
        return share


def run_worker(fault: str, share: int, folder: Path, results: Results) -> None:
    """Run one process with its own cell; keep its folder when a trial failed."""
    command = [sys.executable, str(Path(rare_trials.__file__)), fault, str(share), str(folder)]
    failed, told = False, 0
    with (folder / "worker.log").open("wb") as log:
        worker = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True
        )
        watchdog = threading.Timer(CELL_S + share * TRIAL_S, worker.send_signal, [signal.SIGKILL])
        watchdog.start()
        assert worker.stdout is not None
        for line in worker.stdout:
            result = json.loads(line)
            told += 1
            if result["outcome"] not in rare_trials.GOOD:
                failed = True
                result["folder"] = str(folder)
            results.add(result)
        code = worker.wait(30)
        watchdog.cancel()
    with contextlib.suppress(ProcessLookupError):
        os.killpg(worker.pid, signal.SIGKILL)
    if told < share:
        failed = True
        results.add(
            {"outcome": f"worker ended with {code} after {told} of {share}", "folder": str(folder)}
        )
    if not failed:
        shutil.rmtree(folder, ignore_errors=True)


def table_of(fault: str, results: list[dict[str, Any]]) -> Table:
    """Counts by outcome, with the folders of the first failures."""
    table = Table(title=f"{fault}: {len(results)} trials")
    for head in ("outcome", "count", "share", "logs"):
        table.add_column(head, overflow="fold")
    outcomes = Counter(result["outcome"] for result in results)
    for outcome, number in outcomes.most_common():
        folders = dict.fromkeys(
            r["folder"] for r in results if r["outcome"] == outcome and "folder" in r
        )
        table.add_row(
            outcome, str(number), f"{number / len(results):.1%}", "\n".join(list(folders)[:5])
        )
    for key in ("took_s", "gap_periods", "elsewhere_longest", "elsewhere_missed"):
        values = sorted(float(result[key]) for result in results if result.get(key) is not None)
        if values:
            spread = [values[int(share * (len(values) - 1))] for share in (0.5, 0.99, 1.0)]
            table.add_row(
                f"{key}, median / p99 / max",
                str(len(values)),
                "",
                " / ".join(f"{v:.2f}" for v in spread),
            )
    return table


def main() -> None:
    """Run the trials that are missing up to `--trials` and print the table of all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fault", required=True, choices=sorted(rare_trials.TRIALS))
    parser.add_argument(
        "--trials", type=int, default=500, help="total, including those of earlier runs"
    )
    parser.add_argument("--workers", type=int, default=3, help="cells that run in parallel")
    parser.add_argument("--load", type=int, default=2, help="processes that each keep a core busy")
    parser.add_argument(
        "--minutes", type=float, default=600.0, help="start no more workers after this time"
    )
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "rare-faults")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    results = Results(arguments.folder / f"{arguments.fault}.jsonl")
    shares = Shares(arguments.trials - len(results.all))
    end_s = time.monotonic() + 60 * arguments.minutes
    numbers = count(random.randrange(10**6) * 100)
    progress = Console(stderr=True)

    def work() -> None:
        while time.monotonic() < end_s and (share := shares.take()):
            folder = arguments.folder / f"{arguments.fault}-{next(numbers)}"
            folder.mkdir()
            run_worker(arguments.fault, share, folder, results)
            progress.log(f"{len(results.all)}: {dict(Counter(r['outcome'] for r in results.all))}")

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the load processes end too
    with loaded(arguments.load):
        workers = [threading.Thread(target=work, daemon=True) for _ in range(arguments.workers)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join(60 * arguments.minutes + 2 * (CELL_S + BATCH * TRIAL_S))
    Console(width=150).print(table_of(arguments.fault, results.all) if results.all else "no trials")


if __name__ == "__main__":
    main()
