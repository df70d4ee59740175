"""`make bench` continues after any failure of a benchmark, and finally reports failures and missed
goals.
"""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rn_testing.waiting import wait_until

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def all_of_them() -> dict[str, Any]:
    return runpy.run_path(str(FOLDER / "run_all.py"), run_name="run_all")


def python(program: str) -> list[str]:
    return [sys.executable, "-S", "-c", program]


def test_a_missed_limit_is_told_again_and_is_no_failure(all_of_them, capfd):
    ending = all_of_them["run"](
        "slow.py", python("print('a table'); print('missed: 525 ms, expected 400')"), 30.0
    )
    assert (ending.failure, ending.missed) == ("", ["525 ms, expected 400"])
    assert all_of_them["report"]([ending]) == 0
    told = capfd.readouterr().out
    assert "a table" in told.splitlines()[0]
    assert told.count("missed: 525 ms, expected 400") == 2


def test_a_failed_one_makes_the_status_and_not_the_end(all_of_them, capfd):
    endings = [
        all_of_them["run"](f"exits with {code}", python(f"raise SystemExit({code})"), 30.0)
        for code in (3, 0)
    ]
    assert [ending.failure for ending in endings] == ["exit status 3", ""]
    assert all_of_them["report"](endings) == 1
    assert "exits with 3" in capfd.readouterr().out


def test_one_that_takes_too_long_is_ended(all_of_them, capfd):
    ending = all_of_them["run"]("hangs.py", python("import time; time.sleep(600)"), 0.5)
    assert ending.failure == "ended after 0.5 s"
    assert all_of_them["report"]([ending]) == 1
    assert "FAILED, ended after 0.5 s" in capfd.readouterr().out


def test_what_it_has_started_ends_with_it_even_when_it_ignores_the_request(
    all_of_them, monkeypatch
):
    monkeypatch.setitem(all_of_them["_end"].__globals__, "ENDING_S", 0.5)
    program = (
        "import signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(600)'])\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    process = subprocess.Popen(
        python(program), stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    with process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        all_of_them["_end"](process)
    wait_until(lambda: not _lives(child), 60.0, "its child is still there")


def _lives(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_each_benchmark_is_there_and_knows_its_options(all_of_them):
    assert all_of_them["BENCHMARKS"]
    for benchmark in all_of_them["BENCHMARKS"]:
        text = (FOLDER / f"{benchmark.script}.py").read_text(encoding="utf-8")
        for option in (*benchmark.arguments, *benchmark.quick):
            assert not option.startswith("--") or f'"{option}"' in text, (benchmark.script, option)


def test_what_is_no_failure_is_told_in_the_words_that_are_collected(all_of_them):
    """A script with a time limit prints `missed: ...` at the start of a line."""
    for script in ("bench_plugins_list", "bench_ik", "bench_view", "bench_faults"):
        text = (FOLDER / f"{script}.py").read_text(encoding="utf-8")
        assert re.search(rf'print\(\s*f"{all_of_them["MISSED"]}', text), script
