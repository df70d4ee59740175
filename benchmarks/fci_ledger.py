"""Events in the parts of bench_fci_loop.py, stored over several runs."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fci_cell import FciCell, served_fci

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Ledger:
    """Events of one part, a line of JSON each, stored over several goes.

    Attributes:
        folder: its folder.
        rows: events so far.
    """

    def __init__(self, folder: Path, fresh: bool) -> None:
        if fresh:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder.resolve()
        self._path = self.folder / "events.jsonl"
        self._writing = threading.Lock()
        self.rows: list[dict[str, Any]] = []
        if self._path.exists():
            self.rows = [json.loads(line) for line in self._path.read_text().splitlines()]

    def note(self, event: str, **facts: Any) -> None:
        """Append an event, with the monotonic time."""
        row = {"event": event, "at_s": time.monotonic(), **facts}
        with self._writing:
            self.rows.append(row)
            with self._path.open("a") as lines:
                lines.write(json.dumps(row) + "\n")

    def all(self, event: str) -> list[dict[str, Any]]:
        """Every row of a kind."""
        return [row for row in self.rows if row["event"] == event]

    def goes(self) -> list[tuple[Path, float, float]]:
        """For each run in which the arm moved: its folder, its start, and the time of the last
        event [s].
        """
        found, folder, began_s = list[tuple[Path, float, float]](), "", 0.0
        for row in self.rows:
            if row["event"] == "go":
                folder, began_s = row["folder"], 0.0
            elif row["event"] == "began":
                began_s = row["at_s"]
                found.append((self.folder / folder, began_s, began_s))
            elif began_s:
                found[-1] = (*found[-1][:2], row["at_s"])
        return found

    def done_s(self) -> float:
        """Total time of motion over all goes."""
        return sum(last_s - began_s for _, began_s, last_s in self.goes())

    @contextlib.contextmanager
    def go(self, busy: int, factor: float) -> Iterator[FciCell]:
        """Start another go: a cell with its own folder."""
        folder = self.folder / f"go-{len(self.all('go')) + 1}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        self.note(
            "go",
            folder=folder.name,
            load=os.getloadavg()[0],
            cores=os.cpu_count(),
            busy=busy,
            factor=factor,
        )
        with served_fci(folder, factor=factor) as cell:
            yield cell


def stolen_s() -> float:
    """Time that the hypervisor gave to others while this machine was ready to run, summed over
    cores (proc(5), steal).
    """
    return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) * _TICK_S


def look(cell: FciCell, ledger: Ledger, before: str) -> str:
    """Note a new fault and the state of the loop, and recover; returns the fault."""
    detail = cell.agent.modules()["robot"].get("detail") or {}
    fault = str(detail.get("fault", ""))
    if fault:
        if fault != before:
            ledger.note("fault", fault=fault)
            print(f"    fault: {fault}", flush=True)
        with contextlib.suppress(RuntimeError):
            cell.agent.do("recover_robot")
    rate = float(detail.get("control_success_rate", 0.0))
    ledger.note("look", rate=rate, stolen_s=stolen_s(), realtime=detail.get("realtime", ""))
    return fault
