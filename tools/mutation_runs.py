"""Execution of a mutant's tests by mutmut: order and time limits."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
from mutmut import __main__ as mutmut_run
from mutmut.runners.harness import PytestRunner
from mutmut.state import state
from mutmut.workers import isolation

_QUICK_S = 0.2
_LOOK_S = 0.5
_MOST_SLEEP_S = 20.0


def install(folders: Sequence[str], *, goes_on: bool) -> None:
    """Run quick tests first, those of the first folder before others, and bound mutants by
    `_end_sleeper`; with `goes_on`, only mutants without a result.

    Objects loaded before the first mutant are excluded from garbage collection, which would copy
    that memory in each mutant's process. The first failing test ends a mutant's run. CPU time is
    bounded by mutmut with RLIMIT_CPU; its wall-clock limit is replaced, because a busy machine
    exceeds it.
    """
    submit = isolation.ForkServerRunner.submit

    def submit_in_order(
        self: isolation.ForkServerRunner,
        mutant: str,
        tests: list[str],
        limit_s: int,
        estimate_s: float,
    ) -> None:
        durations_s = state().duration_by_test

        def place(test: str) -> tuple[bool, int, str]:
            folder = next(
                (number for number, name in enumerate(folders) if test.startswith(name)),
                len(folders),
            )
            return durations_s.get(test, 0.0) > _QUICK_S, folder, test

        submit(self, mutant, sorted(tests, key=place), limit_s, estimate_s)

    run_tests = PytestRunner.run_tests

    def run_and_notice(self: PytestRunner, **options: Any) -> int:
        try:
            return int(run_tests(self, **options))
        except Exception as error:
            if not _is_warning(error):
                raise
            return 1

    warm_up = PytestRunner.warm_up

    def warm_up_and_freeze(self: PytestRunner) -> None:
        warm_up(self)
        gc.collect()
        gc.freeze()

    PytestRunner.run_tests = run_and_notice
    PytestRunner.warm_up = warm_up_and_freeze
    isolation.ForkServerRunner.submit = submit_in_order
    isolation.register_timeout = _watch
    if goes_on:
        collect = mutmut_run.collect_source_file_mutation_data

        def collect_unknown(**options: Any) -> tuple[list[Any], dict[str, Any]]:
            """mutmut repeats every mutant given by name, such as the functions of a part."""
            mutants, files = collect(**options)
            return [mutant for mutant in mutants if mutant[2] is None], files

        mutmut_run.collect_source_file_mutation_data = collect_unknown


def _is_warning(error: BaseException) -> bool:
    """True if pytest raised a warning at its own end that occurred after the last test, as in a
    thread.
    """
    if isinstance(error, BaseExceptionGroup):
        return all(map(_is_warning, error.exceptions))
    return isinstance(error, Warning)


def _watch(process: int, _limit_s: float) -> None:
    threading.Thread(target=_end_sleeper, args=(process,), daemon=True).start()


def _end_sleeper(process: int) -> None:
    """End a mutant's process once it and its children have slept for `_MOST_SLEEP_S` in total."""
    slept_s = 0.0
    while slept_s < _MOST_SLEEP_S:
        time.sleep(_LOOK_S)
        try:
            found = psutil.Process(process)
            states = [
                state
                for one in (found, *found.children(recursive=True))
                for state in _thread_states(one.pid)
            ]
        except psutil.Error:
            return
        if not states or "Z" in states[:1]:
            return
        slept_s += _LOOK_S if set(states) <= set("SZ") else 0.0
    for child in found.children(recursive=True):
        child.kill()
    os.kill(process, signal.SIGXCPU)


def _thread_states(process: int) -> list[str]:
    """States of a process's threads, as in proc(5): R is running or runnable, S sleeping, Z
    ended.
    """
    states = []
    with suppress(OSError):  # the process has ended
        for path in Path(f"/proc/{process}/task").glob("*/stat"):
            with suppress(OSError):  # the thread has ended
                states.append(path.read_text("utf-8", "replace").rpartition(")")[2].split()[0])
    return states
