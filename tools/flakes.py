"""Find tests that can fail: run test files many times under several conditions, and keep a ledger.

    python tools/flakes.py --minutes 60                  # units that wait, alone; then the others
    python tools/flakes.py --lane ros --alone 5 --others 0
    python tools/flakes.py plugins/rn-link/tests/test_*.py --alone 50
    python tools/flakes.py --report                      # only print the ledger

Files that start processes or threads, wait or ask a clock run alone; the rest runs together. Each
repetition has another order of tests, and takes the next combination of interpreter, busy loops and
workers. It goes on where it was, if the commit is the same, and ends when the tree changes. The
exit status is 1 if a test failed.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from flake_trials import LANES, Row, Trial, run_trial, waits

ROOT = Path(__file__).parents[1]
PATTERNS = ("tests/**/test_*.py", "*/tests/**/test_*.py", "plugins/*/tests/**/test_*.py")
LEDGER = "ledger.jsonl"
TRIAL_S = 1500.0
"""Longest duration of one trial."""


def numbers(text: str) -> tuple[int, ...]:
    """Parse numbers that are separated by commas. Raises ValueError if they are none."""
    return tuple(int(part) for part in text.split(","))


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", help="test files; default: all of the lane")
    parser.add_argument("--root", type=Path, default=ROOT, help="of the repository")
    parser.add_argument("--folder", type=Path, help="of the ledger; default: out/flakes")
    parser.add_argument("--lane", choices=[*LANES], default="units")
    parser.add_argument("--minutes", type=float, default=60.0, help="begin no trial after that")
    parser.add_argument("--alone", type=int, default=50, help="runs of each file that waits")
    parser.add_argument("--others", type=int, default=5, help="runs of the rest, together")
    cores = os.cpu_count() or 1
    parser.add_argument("--busy", type=numbers, default=(0, cores), help="busy loops: 0,2")
    parser.add_argument("--workers", type=numbers, default=(1, 8), help="of pytest-xdist: 1,8")
    parser.add_argument(
        "--python", type=lambda text: text.split(","), default=[sys.executable], help="PATH,PATH"
    )
    parser.add_argument("--report", action="store_true", help="run nothing, print the ledger")
    parser.add_argument("--commit", default="", help="print the rows of this commit only")
    return parser.parse_args(arguments)


def plan(options: argparse.Namespace) -> Iterator[Trial]:
    """Trials in their order: each file once, then each once more."""
    files = [Path(name).resolve() for name in options.files] or [
        path for pattern in PATTERNS for path in options.root.glob(pattern)
    ]
    mark = "mark.ros" if options.lane != "units" else ""
    texts = {
        str(path.relative_to(options.root.resolve())): path.read_text(encoding="utf-8")
        for path in sorted({path.resolve() for path in files if ".venv" not in path.parts})
    }
    alone = [name for name, text in texts.items() if mark in text and waits(text)]
    rest = tuple(name for name, text in texts.items() if mark in text and name not in alone)
    conditions = list(itertools.product(options.python, options.busy, options.workers))
    for number in range(max(options.alone, options.others)):
        together: list[tuple[str, ...]] = [(name,) for name in alone] * (number < options.alone)
        if rest and number < options.others:
            together.append(rest)
        for place, group in enumerate(together):
            # by place too, so that few repetitions show all conditions
            python, busy, workers = conditions[(number + place) % len(conditions)]
            yield Trial(
                files=group,
                lane=options.lane,
                python=python,
                busy=busy,
                workers=workers,
                number=number,
            )


def commit_of(root: Path) -> str:
    """Commit of the tree, with a mark if it was changed; empty outside git."""
    told = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--exclude", "*"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    return told.stdout.strip()


def read_ledger(path: Path) -> list[Row]:
    """Rows of the ledger; a line that was cut short is named and left out."""
    rows = []
    for number, line in enumerate(path.read_text().splitlines() if path.exists() else (), 1):
        try:
            rows.append(Row.from_line(line))
        except ValueError as error:
            print(f"{path}:{number} is left out: {error}", file=sys.stderr)
    return rows


def work(options: argparse.Namespace, ledger: Path) -> None:
    """Run the trials that the ledger lacks, as long as there is time."""
    commit = commit_of(options.root)
    known = {row.trial for row in read_ledger(ledger) if row.commit == commit}
    end_s = time.monotonic() + 60.0 * options.minutes
    trials = list(plan(options))
    for count, trial in enumerate(trials, 1):
        if trial in known:
            continue
        if time.monotonic() > end_s:
            print(f"The time is over after {count - 1} of {len(trials)} trials.")
            return
        if commit_of(options.root) != commit:
            print(f"The tree is no longer {commit}, so that results would be mixed: ended.")
            return
        row = run_trial(options.root, trial, commit, TRIAL_S)
        with ledger.open("a", encoding="utf-8") as file:
            file.write(row.to_line())
        if row.failed or row.ended:
            told = row.ended or ", ".join(row.failed)
            print(f"{count}/{len(trials)} {trial.condition} load={row.load}: {told}", flush=True)


def report(rows: Sequence[Row]) -> int:
    """Print failures by test; return their number."""
    runs: Counter[str] = Counter()
    by_condition: Counter[tuple[str, str]] = Counter()
    failures: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        for file in row.trial.files:
            runs[file] += 1
            by_condition[file, row.trial.condition] += 1
        for test in row.failed or ([_name(row.trial)] if row.ended else ()):
            failures[test].append(row)
    print(
        f"{len(rows)} trials of {len(runs)} files, {sum(row.passed for row in rows)} tests passed, "
        f"{sum(map(len, failures.values()))} failures of {len(failures)} tests."
    )
    for test, found in sorted(failures.items(), key=lambda item: -len(item[1])):
        file = test.partition("::")[0]
        print(f"\n{test}\n  {len(found)} of {runs[file] or len(found)} runs failed")
        for condition, count in Counter(row.trial.condition for row in found).items():
            print(f"    {condition}: {count} of {by_condition[file, condition] or count}")
        for line, count in Counter(row.failed.get(test, row.ended) for row in found).items():
            print(f"  {count} x {line}")
    return len(failures)


def _name(trial: Trial) -> str:
    more = len(trial.files) - 1
    return trial.files[0] + (f" and {more} more files" if more else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    folder = options.folder or options.root / "out" / "flakes"
    folder.mkdir(parents=True, exist_ok=True)
    ledger = folder / LEDGER
    if not options.report:
        work(options, ledger)
    commit = options.commit or (commit_of(options.root) if not options.report else "")
    rows = [row for row in read_ledger(ledger) if not commit or row.commit == commit]
    return 1 if report(rows) else 0


if __name__ == "__main__":
    raise SystemExit(main())
