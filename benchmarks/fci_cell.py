"""A served FR3 behind franka-sim: server, modules and simulator are separate processes, the agent
is this one.

Results come from the record of the simulator: its joints, 1000 times per second, with monotonic
times.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plugin_site import installed
from soak_cell import until

from rn_robot_fr3.fci.addresses import free_address
from rn_robot_fr3.fci.simulator import FrankaSim
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.agent import BlockingAgent, blocking_client
from roboneuron.ros.environment import prepare_environment

sys.path.append(str(Path(__file__).parents[1] / "plugins" / "rn-robot-fr3" / "tests"))
from fci_box.control_box import ControlBox

F64 = NDArray[np.float64]
STRICT = ("--enforce-motion-limits", "--enforce-comm-constraints")
PYTHON = Path(
    os.environ.get(
        "ROBONEURON_FR3SIM_PYTHON", Path(__file__).parents[1] / ".venv-fr3sim/bin/python"
    )
)
HOME = np.array(HOME_RAD)
STILL_RAD_S = 0.02
"""Joint velocity below which the arm counts as standing. The simulated servo creeps for 0.1 s over
the last 0.01 rad/s.
"""
_COLUMNS = 15
CONFIG = """
[robot]
name = "fr3"
driver = "fci"
server_timeout_s = {server_timeout_s}
[perception]
source = "blank"
cameras = ["front"]
[inference]
backend = "sway"
instruction = "sway"
[control]
controller = "urdf"
server_timeout_s = {server_timeout_s}
[server]
reset_emergency_stop = "client"
[supervisor]
state_directory = "{folder}/state"
start_timeout_s = 180.0
[plugins.fr3]
host = "{host}"
realtime = "ignored"
gripper = false
dynamics_factor = {factor}
[plugins.swing]
tag = 2
{more}
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Record:
    """Record of the simulator's joints.

    Attributes:
        at_s: float64 (n,), monotonic time.
        position, velocity: float64 (n, 7) [rad, rad/s].
    """

    at_s: F64
    position: F64
    velocity: F64

    def since(self, begin_s: float, end_s: float = np.inf) -> Record:
        """The part between two times."""
        first, last = np.searchsorted(self.at_s, [begin_s, end_s])
        return Record(
            at_s=self.at_s[first:last],
            position=self.position[first:last],
            velocity=self.velocity[first:last],
        )

    def rest_s(self) -> float:
        """Time at which the arm finally came to rest; inf if it moves at the end."""
        moving = np.flatnonzero(np.abs(self.velocity).max(axis=1) > STILL_RAD_S)
        if len(moving) == 0:
            return float(self.at_s[0])
        return float(self.at_s[moving[-1] + 1]) if moving[-1] + 1 < len(self.at_s) else np.inf


def read_record(path: Path, last_s: float | None = None) -> Record:
    """The simulator's record so far; only the newest `last_s` seconds (at 1000 rows a second) if
    given.
    """
    size = path.stat().st_size // (8 * _COLUMNS)
    skip = 0 if last_s is None else max(0, size - round(last_s * 1000))
    rows = np.fromfile(path, offset=skip * 8 * _COLUMNS, count=(size - skip) * _COLUMNS).reshape(
        -1, _COLUMNS
    )
    return Record(at_s=rows[:, 0], position=rows[:, 1:8], velocity=rows[:, 8:])


class FciCell:
    """The cell and its operations.

    Attributes:
        agent: the MCP client, with every role.
        link: a separate node on the same graph.
        folder: folder of state, logs and the record.
        server: process id of the server.
        box: the control box before franka-sim, in a cell that has one.
        refusal: error of the newest `move`.
    """

    def __init__(
        self,
        agent: BlockingAgent,
        link: Any,
        sim: FrankaSim,
        folder: Path,
        box: ControlBox | None = None,
    ) -> None:
        self.agent, self.link, self.folder, self.box = agent, link, folder, box
        self._sim = sim
        self.refusal = ""
        self.server = int(agent.do("get_status")["pid"])

    def record(self, last_s: float | None = None) -> Record:
        """The simulator's record until now."""
        # if its network is cut, its buffer is still written now and then
        with contextlib.suppress(OSError):
            self._sim.tell(flush=1)
        return read_record(self.folder / "record.bin", last_s)

    def sim_log(self) -> str:
        """The simulator's output."""
        return (self.folder / "franka-sim.log").read_text(errors="replace")

    def speed(self) -> float:
        """Present velocity of the simulator's fastest joint [rad/s]."""
        return float(np.abs(self._sim.tell()["velocities"]).max())

    def position(self) -> F64:
        """Present positions of the simulator's joints [rad]."""
        return np.array(self._sim.tell()["joints"][:7])

    def pid(self, kind: str) -> int:
        """Pid of a module's process."""
        return int(self.agent.modules()[kind]["pid"])

    def fault(self) -> str:
        """The driver's fault; empty for none."""
        return str((self.agent.modules()["robot"].get("detail") or {}).get("fault", ""))

    def start(self, *kinds: str) -> None:
        """Start those modules that do not run."""
        running = {
            kind for kind, module in self.agent.modules().items() if module["phase"] == "running"
        }
        for kind in kinds:
            if kind not in running:
                self.agent.do(f"start_{kind}")

    def start_policy(self) -> None:
        """Start everything; returns when the arm moves."""
        self.start("robot", "perception", "control")
        self.agent.do("start_inference", instruction="sway")
        until(lambda: self.speed() > 5 * STILL_RAD_S, 30.0, "the arm moves")

    def move(self, target: F64, duration_s: float) -> threading.Thread:
        """Start a `move_joints`; afterwards `refusal` has its error."""
        self.refusal = ""
        positions = dict(zip(ARM_JOINTS, map(float, target), strict=True))

        def call() -> None:
            try:
                self.agent.do("move_joints", positions=positions, duration_s=duration_s)
            except RuntimeError as error:
                self.refusal = str(error)

        thread = threading.Thread(target=call, daemon=True)
        thread.start()
        return thread


@contextlib.contextmanager
def served_fci(
    folder: Path,
    *,
    options: Sequence[str] = STRICT,
    factor: float = 0.5,
    server_timeout_s: float = 1.0,
    host: str | None = None,
    prefix: Sequence[str] = (),
    more: str = "",
    with_box: bool = False,
) -> Iterator[FciCell]:
    """A cell in which only the server and the simulator run; everything ends with it.

    Args:
        folder: an empty folder for all files.
        options: options of franka-sim.
        factor: the option dynamics_factor.
        server_timeout_s: timeout of robot and control.
        host, prefix: address of franka-sim, and prefix of its command, as in `FrankaSim`.
        more: further TOML.
        with_box: put a `ControlBox` between driver and franka-sim; it is the cell's `box`.
    """
    options = (*options, "--no-gripper", "--record", str(folder / "record.bin"))
    sim = FrankaSim(
        PYTHON, seed=1, options=options, log=folder / "franka-sim.log", host=host, prefix=prefix
    )
    box = ControlBox(free_address(1337, 1340), sim.host, folder / "box.log") if with_box else None
    at = box.host if box else sim.host
    text = CONFIG.format(
        folder=folder, factor=factor, server_timeout_s=server_timeout_s, host=at, more=more
    )
    path = folder / "roboneuron.toml"
    path.write_text(text)
    with installed(folder, "rn-fci-cell", ("fci_plugin",)), sim, box or contextlib.nullcontext():
        prepare_environment(folder / "log")
        from roboneuron.ros.link import RosLink  # heavy

        link = RosLink("witness")
        link.open()
        try:
            with blocking_client(path, os.environ, "--log-level", "error") as (client, portal):
                yield FciCell(BlockingAgent(client, portal), link, sim, folder, box)
        finally:
            link.close()


@contextlib.contextmanager
def frozen(pid: int) -> Iterator[None]:
    """Suspend a process within the block."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def watched(check: Callable[[], bool], limit_s: float) -> bool:
    """True if the check succeeds in time."""
    deadline_s = time.monotonic() + limit_s
    while not check():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.005)
    return True
