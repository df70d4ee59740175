"""A run: executes the episodes missing in the ledger on a pool of workers."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from rich.console import Console

from rn_eval.ledger import Ledger
from rn_eval.plan import EvalPlan
from rn_eval.pools import Pool
from rn_eval.progress import ProgressView
from rn_eval.record import EpisodeRecord
from rn_eval.runner import refuse_early
from roboneuron.command import discover


def evaluate(
    plan: EvalPlan,
    directory: Path,
    pool: Callable[[], Pool],
    console: Console,
    *,
    retry_errors: bool = False,
    other_versions: bool = False,
) -> list[EpisodeRecord]:
    """Run the missing episodes and return the records of all episodes of the plan.

    Args:
        plan: the episodes of the finished run.
        directory: directory of the ledger; an interrupted run is resumed.
        pool: creates the workers; called only if something is missing.
        console: for progress.
        retry_errors: run crashed episodes once more.
        other_versions: resume even if package versions have changed since the start of the run.

    Raises:
        RoboNeuronError: the plan is inconsistent, the ledger belongs to another plan, or a policy
            cannot be loaded.
    """
    refuse_early(plan)
    episodes = plan.build_suite(discover()).episodes(plan.episodes, plan.first_seed)
    jobs = list(plan.jobs(episodes))
    with Ledger(directory, other_versions=other_versions) as ledger:
        ledger.open(plan.with_latencies())
        if ledger.cut_bytes:
            console.print(
                f"A line that was cut short ({ledger.cut_bytes} bytes) is removed; its episode is "
                "run again."
            )
        done = ledger.records
        crashed = (
            {key for key, record in done.items() if record.outcome.status == "error"}
            if retry_errors
            else set()
        )
        missing = [job for job in jobs if job.key not in done or job.key in crashed]
        there = [done[job.key] for job in jobs if job.key in done and job.key not in crashed]
        if there and missing:
            console.print(
                f"{len(there)} of {len(jobs)} episodes are in the ledger; {len(missing)} are left."
            )
        try:
            if missing:
                view = ProgressView(console, plan.variants, len(jobs), there)
                with view as progress, pool() as workers, exit_on_sigterm():
                    for finished in workers.run(missing):
                        ledger.add(finished.record, finished.strip)
                        progress.add(finished.record)
        except (KeyboardInterrupt, SystemExit):
            kept = sum(job.key in ledger.records for job in jobs)
            console.print(
                f"{kept} of {len(jobs)} episodes are in the ledger; the same command runs the "
                "others."
            )
            raise
        return [ledger.records[job.key] for job in jobs]


@contextmanager
def exit_on_sigterm() -> Iterator[None]:
    """Let SIGTERM end the run like Ctrl-C; Ray, which is running by then, would abort with a stack
    trace.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _exit)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGTERM) is _exit:
            signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


def _exit(number: int, frame: object) -> NoReturn:
    # because make and timeout send it twice, and the second must not interrupt the shutdown
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)
