"""A few trials of benchmarks/bench_link_faults.py, which draws faults of the link to a policy's
server and judges the arm's motion (needs root); and errors that the judge must detect.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from link_fault_judge import LOCAL, REMOTE, STEP_M, TAIL_AGE_S, Judge, Row
from link_faults import Trial
from link_machines import impossible

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "bench_link_faults.py"
CHOSEN = {
    0: "cable cut",
    1: "replayed answer",
    12: "server frozen",
    15: "garbage",
    20: "server killed",
    22: "server killed",
    45: "answers' records twice",
    49: "requests' records twice",
    53: "an old record again",
}
"""Trials, some of them with a fallback."""


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible")
def test_an_arm_keeps_its_bounds_whatever_becomes_of_its_remote_policy(tmp_path: Path) -> None:
    assert {number: Trial.of(number).kind for number in CHOSEN} == CHOSEN
    words = ["--only", *map(str, CHOSEN), "--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = (tmp_path / "trials.jsonl").read_text().splitlines()
    assert sorted(json.loads(line)["number"] for line in lines) == sorted(CHOSEN)


class Seen:
    """Invented observations of a witness: an arm that moves 1 mm every 50 ms, and rows."""

    def __init__(self, *rows: Row, more: tuple[tuple[float, float], ...] = ()) -> None:
        self._rows = list(rows)
        start_s = time.time() - 2.0
        self._joints = [(start_s + 0.05 * i, 0.001 * i) for i in range(40)] + list(more)

    def joints(self, since_s: float) -> list[tuple[float, float]]:
        return [place for place in self._joints if place[0] >= since_s]

    def since(self, since_s: float, tag: int | None = None) -> list[Row]:
        return [row for row in self._rows if row.at_s >= since_s and tag in (None, row.tag)]


def judge(number: int, *rows: Row, more: tuple[tuple[float, float], ...] = ()) -> Any:
    return Judge(Seen(*rows, more=more), str, Trial.of(number))  # type: ignore[arg-type]


def test_the_judge_sees_a_jump_a_rest_and_an_arm_beyond_its_limits() -> None:
    now_s = time.time()
    told: dict[str, Any] = {}
    assert judge(0)._motion(now_s - 1.0, told) == []
    assert told["stood_s"] < 0.1
    jump = judge(0, more=((now_s, 0.04 + 2 * STEP_M),))
    assert "the arm jumped" in jump._motion(now_s - 1.0, {})
    far = judge(0, more=((now_s, 9.0),))
    assert "a joint left its limits" in far._motion(now_s - 1.0, {})
    assert judge(0, more=((now_s + 2.0, 0.05),))._motion(now_s - 1.0, told) == ["the arm jumped"]
    assert told["stood_s"] > 1.5


def test_the_judge_sees_rows_of_old_images_and_images_out_of_order() -> None:
    now_s = time.time()
    good = [Row(now_s - 0.1 * i, 0.2, 100 - i, REMOTE) for i in range(9, -1, -1)]
    assert judge(0, *good)._ages(now_s - 1.0, {}) == []
    replayed = judge(0, *good, Row(now_s, 0.4, 95, REMOTE))._ages(now_s - 1.0, {})
    assert replayed == ["image 95 after 100"]
    late = judge(0, *good, Row(now_s, TAIL_AGE_S + 1.0, 100, REMOTE))._ages(now_s - 1.0, {})
    assert late == [f"a row of an image of {TAIL_AGE_S + 1.0:.2f} s"]


def test_the_judge_sees_who_moved_the_arm_when_it_should_not() -> None:
    end_s = time.time()
    fault_s = end_s - 4.0
    alone, beside = 0, 2  # a cut cable without and with a fallback
    late = Row(fault_s + 3.0, 0.2, 9, REMOTE)
    assert judge(alone, late)._places(fault_s, end_s, {}) == ["it moved on without answers"]
    assert judge(alone)._places(fault_s, end_s, {}) == []
    none = judge(beside)._places(fault_s, end_s, {})
    assert none == ["the fallback did not take over"]
    told = {"stood_s": 0.1}
    taken = [Row(fault_s + 0.3 + 0.05 * i, 0.1, i, LOCAL) for i in range(20)]
    early = judge(beside, *taken, Row(fault_s + 2.0, 0.2, 99, REMOTE))
    assert early._places(fault_s, end_s, told) == ["it gave back before three good seconds"]
