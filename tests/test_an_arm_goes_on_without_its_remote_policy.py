"""The server of a policy freezes, is killed, and comes back: the arm continues with its fallback,
without a hold and without a jump.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from fault_loop import JointWitness, moving_cell

from rn_testing.waiting import wait_until
from roboneuron.server.loop import ClosedLoop
from roboneuron.tools.loop.results import ModuleStatus

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(120)]
RATE_HZ = 20.0
SHARED = """
[plugins.shared]
backend = "first"
stateless = true
directory = "{folder}/servers"
timeout_s = 1.0
"""
PEAK_M = 0.003
"""The policy's longest step is 2 mm; the rest is what the limits let it catch up."""


class Cell:
    """A gantry that follows a policy in a separate process, or its fallback."""

    def __init__(self, loop: ClosedLoop, witness: JointWitness, folder: Path) -> None:
        self.loop, self.witness, self._folder = loop, witness, folder

    def status(self, kind: str) -> ModuleStatus:
        return ModuleStatus.of(self.loop.modules.view(kind))  # type: ignore[arg-type]

    def acting(self) -> str:
        return self.status("inference").metrics.get("fallback.acting", "")

    def holds(self) -> int:
        return self.status("control").dropped_by.get("holds", 0)

    def server(self) -> psutil.Process:
        """The process that holds the first policy."""
        folder = str(self._folder)
        for process in psutil.process_iter(["cmdline"]):
            line = " ".join(process.info["cmdline"] or ())
            if "rn_backend_openpi.server_process" in line and folder in line:
                return process
        raise AssertionError("no server of this cell runs")

    def watch(self, until: Callable[[], bool], most_s: float) -> None:
        """Wait for a condition while the arm never stands."""
        end_s = time.monotonic() + most_s
        while not until():
            assert time.monotonic() < end_s, self.status("inference").metrics
            assert self.witness.stood_s() < 0.5, self.status("control").note
            time.sleep(0.02)


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    pytest.importorskip("rn_backend_openpi")
    more = {
        "backend": "shared",
        "inference": 'fallback = "second"',
        "camera": SHARED.format(folder=tmp_path),
    }
    (tmp_path / "servers").mkdir(mode=0o700)
    with moving_cell(tmp_path, RATE_HZ, **more) as (loop, witness):
        made = Cell(loop, witness, tmp_path)
        wait_until(witness.moves, 10.0, "the arm moves")
        wait_until(lambda: made.acting() == "shared", 5.0, "by the first policy")
        server = made.server()
        yield made
        for process in {server.pid, *_pids(made)}:
            psutil.Process(process).kill() if psutil.pid_exists(process) else None


def _pids(cell: Cell) -> list[int]:
    try:
        return [cell.server().pid]
    except AssertionError:
        return []


def test_a_frozen_server_is_stood_in_for_until_it_is_in_time_again(cell: Cell) -> None:
    before, since_s = cell.holds(), time.monotonic()
    server = cell.server()
    os.kill(server.pid, signal.SIGSTOP)
    try:
        cell.watch(lambda: cell.acting() == "second", 3.0)
        frozen_s = time.monotonic()
        cell.watch(lambda: time.monotonic() - frozen_s > 3.0, 5.0)
    finally:
        os.kill(server.pid, signal.SIGCONT)
    cell.watch(lambda: cell.acting() == "shared", 15.0)
    cell.watch(lambda: time.monotonic() - since_s > 8.0, 15.0)
    assert cell.status("inference").metrics["fallback.count"] == "1"
    assert cell.holds() == before
    assert cell.witness.largest_step_m(since_s) < PEAK_M


def test_a_killed_server_is_stood_in_for_until_a_new_one_answers(cell: Cell) -> None:
    before, since_s = cell.holds(), time.monotonic()
    killed = cell.server()
    killed.kill()
    cell.watch(lambda: cell.acting() == "second", 3.0)
    cell.watch(lambda: cell.acting() == "shared", 30.0)
    assert cell.server().pid != killed.pid
    assert cell.holds() == before
    assert cell.witness.largest_step_m(since_s) < PEAK_M
