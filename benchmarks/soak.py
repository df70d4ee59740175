"""The loop for half an hour: 30 Hz, 640x480, a switch of the backend every minute, a random fault every two.

    python benchmarks/soak.py [--minutes 30] [--switch-s 60] [--fault-s 120] [--seed 1] [--json out.json]

A real server runs as an agent's client would start it, on stdio; the agent is this process. Memory (resident, without
what is shared), open handles and threads of every process and Fast DDS's files in shared memory are sampled, and a line
is fitted through what was sampled after the warm-up. It fails when something grows by more than `GROWTH` over that
time, when a fault is not recovered from as configured, or when a switch misses its time.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from anyio.from_thread import BlockingPortal, start_blocking_portal
from mcp import Client, StdioServerParameters
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parent))
from fault_loop import PARTS, JointWitness, config_text, environment, fail

from roboneuron.ros.environment import prepare_environment

sys.path.pop(0)

KINDS = ("robot", "perception", "control", "inference")
GROWTH = {"memory_mb": 8.0, "handles": 6.0, "threads": 4.0, "shm_files": 12.0, "shm_mb": 40.0}
"""Most that each may grow by over the time after the warm-up, by the fitted line; noise of a minute stays below."""
SETTLE_S = 3.0
"""A process younger than this is still loading: not sampled."""
MOVES_AGAIN_S = 30.0
"""A module that has to be started again is, within this time, on a machine that is busy."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """What a soak does; times in seconds."""

    duration_s: float = 1800.0
    switch_s: float = 60.0
    fault_s: float = 120.0
    sample_s: float = 5.0
    warm_up_s: float = 120.0
    rate_hz: float = 30.0
    width: int = 640
    height: int = 480
    seed: int = 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """One fault or switch: when, what, whether it went as configured, and how long that took."""

    at_s: float
    what: str
    ok: bool
    took_s: float
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Trend:
    """One quantity of one process.

    Attributes:
        first, last: medians of the first and last tenth after the warm-up.
        growth: of the fitted line over that time.
        limit: what it may be.
    """

    process: str
    quantity: str
    first: float
    last: float
    growth: float
    limit: float

    @property
    def ok(self) -> bool:
        """Whether it does not grow."""
        return self.growth <= self.limit


@dataclass(kw_only=True, slots=True)
class Report:
    """What a soak saw."""

    seconds: float = 0.0
    actions: int = 0
    outcomes: list[Outcome] = field(default_factory=list)
    trends: list[Trend] = field(default_factory=list)

    @property
    def problems(self) -> list[str]:
        """Why it failed; empty when it did not."""
        bad = [f"{o.what} at {o.at_s:.0f} s: {o.note}" for o in self.outcomes if not o.ok]
        return bad + [
            f"{t.quantity} of {t.process} grew by {t.growth:.1f} from {t.first:.1f}, at most {t.limit:g}"
            for t in self.trends
            if not t.ok
        ]


class Agent:
    """The MCP client; calls block."""

    def __init__(self, client: Client, portal: BlockingPortal) -> None:
        self._client, self._portal = client, portal

    def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Structured content of a call; RuntimeError with the server's reason when it fails."""
        answer = self._portal.call(self._client.call_tool, tool, arguments)
        if answer.is_error:
            raise RuntimeError(f"{tool}: {answer.content[0].text}")
        return dict(answer.structured_content or {})

    def modules(self) -> dict[str, dict[str, Any]]:
        """get_status by module."""
        return {module["module"]: module for module in self.do("get_status")["modules"]}


def until(fact: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Wait for a fact; RuntimeError when it does not come true in time."""
    deadline_s = time.monotonic() + timeout_s
    while not fact():
        if time.monotonic() > deadline_s:
            raise RuntimeError(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.05)


class Cell:
    """The loop under test, its faults and its joints."""

    def __init__(self, agent: Agent, witness: JointWitness, folder: Path, server: psutil.Process) -> None:
        self.agent, self.witness, self.folder, self.server = agent, witness, folder, server
        self._segments: set[str] = set()

    def pid(self, kind: str) -> int:
        """Of the module's process now."""
        pid = self.agent.modules()[kind]["pid"]
        assert isinstance(pid, int)
        return pid

    def start(self) -> None:
        """Start everything."""
        for kind in ("robot", "perception", "control"):
            self.agent.do(f"start_{kind}")
        self.agent.do("start_inference", instruction="swing")
        until(self.witness.moves, 10.0, "the arm moves")

    def wrong_part(self, part: str, mode: str, duration_s: float, stands: bool = True) -> None:
        """A part misbehaves for a while; the arm stands meanwhile, and moves afterwards by itself."""
        fail(self.folder, part, mode)
        try:
            if stands:
                until(self.witness.stands, duration_s + 2.0, "the arm stands")
            else:
                time.sleep(duration_s)
        finally:
            fail(self.folder, part, "")

    def frozen(self, kind: str, duration_s: float) -> None:
        """A process is stopped for a while."""
        pid = self.pid(kind)
        os.kill(pid, signal.SIGSTOP)
        try:
            until(
                lambda: self.agent.modules()[kind]["health"] in ("silent", "exited", "starting"), 2.0, "it is noticed"
            )
            time.sleep(duration_s)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def killed(self, kind: str, agent_starts: bool) -> None:
        """A process dies; perception comes back by itself, what moves the arm when the agent says so."""
        pid = self.pid(kind)
        os.kill(pid, signal.SIGKILL)
        until(lambda: self.agent.modules()[kind]["pid"] != pid, 2.0, "it is noticed")
        until(self.witness.stands, 3.0, "the arm stands")
        if agent_starts:
            time.sleep(1.0)  # long enough for a restart that must not happen
            if self.agent.modules()[kind]["phase"] != "exited":
                raise RuntimeError(f"{kind} came back by itself")
            more = {"instruction": "swing"} if kind == "inference" else {}
            self.agent.do(f"start_{kind}", **more)

    def stopped(self) -> None:
        """The emergency stop, and its reset."""
        self.agent.do("emergency_stop", reason="soak")
        until(self.witness.stands, 2.0, "the arm stands")
        self.agent.do("reset_emergency_stop")

    def faults(self) -> dict[str, Callable[[], None]]:
        """What can be done to it."""
        return {
            "backend raises": lambda: self.wrong_part("backend", "raise", 1.0),
            "backend hangs": lambda: self.wrong_part("backend", "hang", 1.0),
            "backend answers after 250 ms": lambda: self.wrong_part("backend", "250", 2.0, stands=False),
            "camera repeats its image": lambda: self.wrong_part("camera", "frozen", 1.0),
            "camera's clock jumps": lambda: self.wrong_part("camera_clock", "10", 1.0),
            "joint states are NaN": lambda: self.wrong_part("gantry", "nan", 1.0),
            "joint states are stale": lambda: self.wrong_part("gantry", "stale", 1.0),
            "perception frozen for 0.5 s": lambda: self.frozen("perception", 0.5),
            "perception frozen for 4 s": lambda: self.frozen("perception", 4.0),
            "control frozen for 0.5 s": lambda: self.frozen("control", 0.5),
            "robot frozen for 0.5 s": lambda: self.frozen("robot", 0.5),
            "perception killed": lambda: self.killed("perception", agent_starts=False),
            "inference killed": lambda: self.killed("inference", agent_starts=True),
            "control killed": lambda: self.killed("control", agent_starts=True),
            "emergency stop": self.stopped,
        }

    def is_well(self) -> bool:
        """Everything works and the arm moves."""
        healthy = all(module["health"] == "ok" for module in self.agent.modules().values())
        return healthy and self.witness.moves()

    def switch(self) -> str:
        """Change the backend, warm; returns what was measured."""
        now = self.agent.modules()["inference"]["started_with"]["backend"]
        result = self.agent.do("switch_inference", backend="steadier" if now == "steady" else "steady")
        return f"gap {(result.get('gap_s') or 0.0) * 1e3:.0f} ms, missed {result.get('missed_actions')}"

    def sample(self) -> dict[tuple[str, str], float]:
        """Quantities by process; of processes that have settled."""
        found: dict[tuple[str, str], float] = {}
        processes = {"server": self.server}
        for kind, module in self.agent.modules().items():
            if module["phase"] == "running" and module["pid"]:
                with contextlib.suppress(psutil.NoSuchProcess):
                    processes[kind] = psutil.Process(module["pid"])
        for name, process in processes.items():
            with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
                if time.time() - process.create_time() < SETTLE_S:
                    continue
                memory = process.memory_info()
                found[name, "memory_mb"] = (memory.rss - memory.shared) / 1e6
                found[name, "handles"] = process.num_fds()
                found[name, "threads"] = process.num_threads()
        for process in processes.values():
            self._segments |= _mapped(process.pid)
        sizes = [size for name in self._segments if (size := _size(Path("/dev/shm") / name)) is not None]
        found["all", "shm_files"], found["all", "shm_mb"] = len(sizes), sum(sizes) / 1e6
        return found


def _size(path: Path) -> int | None:
    with contextlib.suppress(OSError):
        return path.stat().st_blocks * 512
    return None


def _mapped(pid: int) -> set[str]:
    """Names of the shared-memory files that a process maps; what one that was killed leaves behind is among them."""
    names: set[str] = set()
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            if "/dev/shm/fastrtps" in line and "(deleted)" not in line:
                names.add(line.rsplit("/dev/shm/", 1)[1])
    return names


@contextlib.contextmanager
def served_cell(folder: Path, settings: Settings) -> Iterator[Cell]:
    """A server with the faulty gantry, an agent and a witness; everything is ended."""
    camera = f"width = {settings.width}\nheight = {settings.height}"
    supervisor = "unresponsive_s = 1.5\nrestart_limit = 100"
    text = config_text(folder, settings.rate_hz, backend="steady", camera=camera, supervisor=supervisor)
    path = folder / "roboneuron.toml"
    path.write_text(text)
    for part in PARTS:
        fail(folder, part, "")
    with environment(folder):
        prepare_environment(folder / "log")
        from roboneuron.ros.link import RosLink  # heavy

        command = ["-m", "roboneuron.cli.main", "serve", "--config", str(path), "--log-level", "error"]
        server = StdioServerParameters(command=sys.executable, args=command, env=dict(os.environ))
        link = RosLink("witness")
        link.open()
        try:
            witness = JointWitness(link.node, link.on_executor)
            with start_blocking_portal() as portal, portal.wrap_async_context_manager(Client(server)) as client:
                agent = Agent(client, portal)
                yield Cell(agent, witness, folder, psutil.Process(agent.do("get_status")["pid"]))
        finally:
            link.close()


def judge(samples: list[tuple[float, dict[tuple[str, str], float]]], warm_up_s: float) -> list[Trend]:
    """Fit a line through each quantity after the warm-up."""
    kept = [(at_s, found) for at_s, found in samples if at_s >= warm_up_s]
    trends = []
    for key in sorted({key for _, found in kept for key in found}):
        at = np.array([at_s for at_s, found in kept if key in found])
        values = np.array([found[key] for _, found in kept if key in found])
        if len(at) < 5:
            continue
        slope = float(np.polyfit(at, values, 1)[0])
        tenth = max(1, len(at) // 10)
        trends.append(
            Trend(
                process=key[0],
                quantity=key[1],
                first=float(np.median(values[:tenth])),
                last=float(np.median(values[-tenth:])),
                growth=slope * float(at[-1] - at[0]),
                limit=GROWTH[key[1]],
            )
        )
    return trends


def run(settings: Settings, folder: Path, tell: Callable[[str], None]) -> Report:
    """Soak a loop; `tell` hears of every switch and fault."""
    report = Report()
    chance = random.Random(settings.seed)
    with served_cell(folder, settings) as cell:
        cell.start()
        started_s = time.monotonic()
        samples: list[tuple[float, dict[tuple[str, str], float]]] = []
        names: list[str] = []
        next_sample, next_switch, next_fault = 0.0, settings.switch_s, settings.fault_s

        def note(what: str, work: Callable[[], str | None]) -> None:
            at_s = time.monotonic() - started_s
            begun_s = time.monotonic()
            try:
                said = work() or ""
                until(cell.is_well, MOVES_AGAIN_S, "everything works again")
                ok = True
            except RuntimeError as error:
                said, ok = f"{error}; {cell.agent.modules()}", False
            took_s = time.monotonic() - begun_s
            report.outcomes.append(Outcome(at_s=at_s, what=what, ok=ok, took_s=took_s, note=said))
            tell(
                f"{at_s:6.0f} s  {what}: {'well' if ok else 'FAILED'} after {took_s:.1f} s {said if ok else said[:300]}"
            )

        while (now_s := time.monotonic() - started_s) < settings.duration_s:
            if now_s >= next_sample:
                next_sample += settings.sample_s
                samples.append((now_s, cell.sample()))
            elif now_s >= next_switch:
                next_switch += settings.switch_s
                note("switch", cell.switch)
            elif now_s >= next_fault:
                next_fault += settings.fault_s
                faults = cell.faults()
                if not names:
                    names = chance.sample(sorted(faults), len(faults))
                name = names.pop()
                note(name, faults[name])
            else:
                time.sleep(0.1)
        report.seconds = time.monotonic() - started_s
        report.actions = cell.witness.actions()
        report.trends = judge(samples, min(settings.warm_up_s, settings.duration_s / 3))
    return report


def main() -> None:
    """Soak, print the tables, fail when something grew or did not recover."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="how long")
    parser.add_argument("--switch-s", type=float, default=60.0, metavar="S", help="time between two switches")
    parser.add_argument("--fault-s", type=float, default=120.0, metavar="S", help="time between two faults")
    parser.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="images per second")
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480], metavar=("W", "H"), help="of the images")
    parser.add_argument("--seed", type=int, default=1, help="of the order of the faults")
    parser.add_argument("--json", type=Path, help="write everything here")
    arguments = parser.parse_args()
    settings = Settings(
        duration_s=arguments.minutes * 60,
        switch_s=arguments.switch_s,
        fault_s=arguments.fault_s,
        rate_hz=arguments.rate,
        width=arguments.size[0],
        height=arguments.size[1],
        seed=arguments.seed,
    )
    console = Console(width=150)
    with tempfile.TemporaryDirectory() as folder:
        report = run(settings, Path(folder), lambda text: console.print(text, highlight=False))
    table = Table(
        title=f"After {report.seconds:.0f} s, {report.actions} actions, {len(report.outcomes)} switches and faults"
    )
    for head in ("process", "quantity", "first tenth", "last tenth", "growth by the fitted line", "allowed"):
        table.add_column(head)
    for t in report.trends:
        mark = "" if t.ok else "  GROWS"
        table.add_row(
            t.process, t.quantity, f"{t.first:.1f}", f"{t.last:.1f}", f"{t.growth:+.2f}{mark}", f"{t.limit:g}"
        )
    console.print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps({"settings": asdict(settings), **asdict(report)}, indent=1))
    for problem in report.problems:
        console.print(f"FAILED: {problem}", highlight=False)
    sys.exit(1 if report.problems else 0)


if __name__ == "__main__":
    main()
