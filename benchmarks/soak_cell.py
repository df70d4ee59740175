"""The test bed of a soak: a served loop with the faulty gantry, its agent, its faults, and samples
of its processes.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
from fault_loop import PARTS, JointWitness, config_text, environment, fail

from rn_testing.agent import BlockingAgent, blocking_client
from roboneuron.ros.environment import prepare_environment

SETTLE_S = 3.0
"""A process younger than this is still loading and is not sampled [s]."""


def until(fact: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Wait until `fact` returns True; RuntimeError when it does not in time."""
    deadline_s = time.monotonic() + timeout_s
    while not fact():
        if time.monotonic() > deadline_s:
            raise RuntimeError(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.05)


class Cell:
    """The loop under test, its faults and its joints."""

    def __init__(
        self, agent: BlockingAgent, witness: JointWitness, folder: Path, server: psutil.Process
    ) -> None:
        self.agent, self.witness, self.folder, self.server = agent, witness, folder, server
        self._segments: set[str] = set()

    def pid(self, kind: str) -> int:
        """Current PID of the module's process."""
        pid = self.agent.modules()[kind]["pid"]
        assert isinstance(pid, int)
        return pid

    def start(self) -> None:
        """Start all modules and wait until the arm moves."""
        for kind in ("robot", "perception", "control"):
            self.agent.do(f"start_{kind}")
        self.agent.do("start_inference", instruction="swing")
        until(self.witness.moves, 10.0, "the arm moves")

    def wrong_part(self, part: str, mode: str, duration_s: float, stands: bool = True) -> None:
        """Let a part fail for a while; with `stands`, wait until the arm stands. It moves again by
        itself.
        """
        fail(self.folder, part, mode)
        try:
            if stands:
                until(self.witness.stands, duration_s + 2.0, "the arm stands")
            else:
                time.sleep(duration_s)
        finally:
            fail(self.folder, part, "")

    def frozen(self, kind: str, duration_s: float) -> None:
        """Suspend a module's process with SIGSTOP for a while."""
        pid = self.pid(kind)
        os.kill(pid, signal.SIGSTOP)
        try:
            until(
                lambda: self.agent.modules()[kind]["health"] in ("silent", "exited", "starting"),
                2.0,
                "it is noticed",
            )
            time.sleep(duration_s)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        # Perception that is suspended for long is restarted, which ends the instruction.
        until(lambda: self.agent.modules()[kind]["phase"] == "running", 60.0, f"{kind} runs again")
        self.swing()

    def killed(self, kind: str, agent_starts: bool) -> None:
        """Kill a process; perception restarts by itself, the modules that move the arm only when
        the agent starts them.
        """
        pid = self.pid(kind)
        os.kill(pid, signal.SIGKILL)
        until(lambda: self.agent.modules()[kind].get("pid") != pid, 2.0, "it is noticed")
        until(self.witness.stands, 3.0, "the arm stands")
        if agent_starts:
            time.sleep(1.0)  # long enough to see a restart that must not happen
            if self.agent.modules()[kind]["phase"] != "exited":
                raise RuntimeError(f"{kind} came back by itself")
            self.agent.do(f"start_{kind}")
        else:
            until(
                lambda: self.agent.modules()[kind]["phase"] == "running", 60.0, f"{kind} runs again"
            )
        self.swing()

    def swing(self) -> None:
        """Give the instruction again when it was cleared: no restart, release or recovery starts
        motion.
        """
        inference = self.agent.modules()["inference"]
        if inference["phase"] == "running" and not inference["instruction"]:
            # The policy does not receive images of a restarted camera immediately, and refuses
            # instructions until it does.
            until(
                lambda: self.agent.modules()["inference"]["health"] != "failing",
                20.0,
                "the policy has images again",
            )
            self.agent.do("set_instruction", instruction="swing")

    def stopped(self) -> None:
        """Latch the emergency stop, wait until the arm stands, and reset the stop."""
        self.agent.do("emergency_stop", reason="soak")
        until(self.witness.stands, 2.0, "the arm stands")
        self.agent.do("reset_emergency_stop")
        self.swing()

    def faults(self) -> dict[str, Callable[[], None]]:
        """All faults by name."""
        return {
            "backend raises": lambda: self.wrong_part("backend", "raise", 1.0),
            "backend hangs": lambda: self.wrong_part("backend", "hang", 1.0),
            "backend answers after 250 ms": lambda: self.wrong_part(
                "backend", "250", 2.0, stands=False
            ),
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
        """Whether all modules are healthy and the arm moves."""
        healthy = all(module["health"] == "ok" for module in self.agent.modules().values())
        return healthy and self.witness.moves()

    def switch(self) -> str:
        """Switch the backend warm; returns the measured gap and misses."""
        now = self.agent.modules()["inference"]["started_with"]["backend"]
        result = self.agent.do(
            "switch_inference", backend="steadier" if now == "steady" else "steady"
        )
        return f"gap {(result.get('gap_s') or 0.0) * 1e3:.0f} ms, missed {result['missed']}"

    def sample(self) -> dict[tuple[str, str], float]:
        """Quantities by process and name, of processes old enough."""
        found: dict[tuple[str, str], float] = {}
        processes = {"server": self.server}
        for kind, module in self.agent.modules().items():
            if module["phase"] == "running" and module.get("pid"):
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
        sizes = [
            size for name in self._segments if (size := _size(Path("/dev/shm") / name)) is not None
        ]
        found["all", "shm_files"], found["all", "shm_mb"] = len(sizes), sum(sizes) / 1e6
        return found


def _size(path: Path) -> int | None:
    with contextlib.suppress(OSError):
        return path.stat().st_blocks * 512
    return None


def _mapped(pid: int) -> set[str]:
    """Names of the Fast DDS shared-memory files that a process maps. Files that a killed process
    leaves behind were recorded while it ran.
    """
    names: set[str] = set()
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            if "/dev/shm/fastrtps" in line and "(deleted)" not in line:
                names.add(line.rsplit("/dev/shm/", 1)[1])
    return names


@contextlib.contextmanager
def served_cell(
    folder: Path, rate_hz: float, size_px: tuple[int, int], policy: str = ""
) -> Iterator[Cell]:
    """Start the faulty gantry, its server, agent and witness, with the backend options `policy`;
    everything is ended at exit.
    """
    camera = f"width = {size_px[0]}\nheight = {size_px[1]}"
    ops = "[ops]\nunresponsive_s = 1.5\nrestart_limit = 100\n"
    text = config_text(folder, rate_hz, backend="steady", camera=camera, policy=policy)
    path = folder / "roboneuron.toml"
    path.write_text(text + ops + '[server]\nreset_emergency_stop = "client"\n')
    for part in PARTS:
        fail(folder, part, "")
    with environment(folder):
        prepare_environment(folder / "log")
        from roboneuron.ros.link import RosLink  # heavy

        link = RosLink("witness")
        link.open()
        try:
            witness = JointWitness(link.node, link.on_executor)
            with blocking_client(path, os.environ, "--log-level", "error") as (client, portal):
                agent = BlockingAgent(client, portal)
                yield Cell(agent, witness, folder, psutil.Process(agent.do("get_status")["pid"]))
        finally:
            link.close()
