"""A served FR3 with protective stops, its agent, an observer of the simulator's joints, and ways to
stop and to continue.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from pathlib import Path
from typing import Any

from anyio.from_thread import BlockingPortal
from fci_cell import PYTHON, STRICT
from joint_witness import Witness
from mcp import Client
from plugin_site import installed

from rn_robot_fr3.fci.simulator import FrankaSim
from rn_standard.ops.maintenance import MaintenanceFile
from rn_testing.agent import BlockingAgent, blocking_client
from roboneuron.estop import ESTOP_FILE, RESET_SUFFIX, EmergencyStopLatch
from roboneuron.feature import AuditLog, Role
from roboneuron.ros.environment import prepare_environment

FRANKA_SIM = "franka-sim"
CONFIG = """
{robot}
[control]
controller = "urdf"
[supervisor]
state_directory = "{folder}/state"
start_timeout_s = 90.0
[server]
reset_emergency_stop = "client"
[ops]
restart_backoff_s = 0.1
restart_limit = 100
restart_window_s = 1.0
[ops.restart]
robot = "{restart}"
control = "{restart}"
inference = "{restart}"
"""
SIMULATED = """
[robot]
name = "fr3r"
[perception]
source = "fr3r-camera"
[inference]
backend = "servo"
instruction = "pick up the yellow cube"
[plugins.fr3r]
engine = "{engine}"
seed = {seed}
fault_file = "{folder}/fault"
"""
OVER_FCI = """
[robot]
name = "fr3"
driver = "fci"
[perception]
source = "blank"
cameras = ["front"]
[inference]
backend = "sway"
[plugins.fr3]
host = "{host}"
realtime = "ignored"
gripper = false
"""
REFLEX = 21
"""The libfranka error that franka-sim is set to raise."""
KINDS = ("robot", "perception", "control", "inference")
NEVER = {"kind": "tcp_in", "lower_m": [9, 9, 9], "upper_m": [10, 10, 10]}
MOVED_RAD = 0.02
"""Distance of a joint from its rest position above which it counts as moved: it sags by less than
0.002.
"""
WATCH_S = 1.5
BRAKE_S = 3.0


class Cell(BlockingAgent):
    """The cell of the sequences; calls block."""

    def __init__(
        self,
        client: Client,
        portal: BlockingPortal,
        witness: Witness,
        link: Any,
        folder: Path,
        sim: FrankaSim | None = None,
    ) -> None:
        super().__init__(client, portal)
        self.folder = folder
        self.witness, self._link, self._sim = witness, link, sim
        self._robot = "fr3r" if sim is None else "fr3"
        self._calls: list[Future[Any]] = []
        self._frozen: set[int] = set()

    def later(self, tool: str, **arguments: Any) -> None:
        """Call without waiting."""
        self._calls.append(self._portal.start_task_soon(self._client.call_tool, tool, arguments))

    def cancel(self) -> None:
        """Cancel the calls of `later`; the client sends `notifications/cancelled` for each."""
        for call in self._calls:
            call.cancel()

    def join(self, timeout_s: float) -> None:
        """Wait for the calls of `later`, up to this time for each."""
        for call in self._calls:
            with contextlib.suppress(Exception, CancelledError):
                call.result(timeout_s)
        self._calls.clear()

    def until(self, fact: Callable[[], bool], within_s: float, what: str) -> None:
        """Wait until a condition is true; RuntimeError otherwise."""
        deadline_s = time.monotonic() + within_s
        while not fact():
            if time.monotonic() > deadline_s:
                raise RuntimeError(f"not within {within_s:g} s: {what}")
            time.sleep(0.02)

    def kill(self, kind: str) -> None:
        """SIGKILL to a module's process."""
        pid = self.modules()[kind]["pid"]
        if pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def freeze(self, kind: str) -> None:
        """SIGSTOP to a module's process, until `resume`."""
        pid = self.modules()[kind]["pid"]
        if pid:
            os.kill(pid, signal.SIGSTOP)
            self._frozen.add(pid)

    def resume(self) -> list[str]:
        """SIGCONT to what is frozen; returns what was done."""
        done = ["resumed"] if self._frozen else []
        for pid in self._frozen:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._frozen.clear()
        return done

    def begin_maintenance(self) -> None:
        """Take the robot out of service as `roboneuron robot maintenance --begin` does."""
        state, audit = self.folder / "state", AuditLog.in_directory(self.folder / "state")
        out = MaintenanceFile(state).begin("a person", Role.ADMIN, "random sequence", audit)
        EmergencyStopLatch.in_directory(state).latch(who=out.who, reason=str(out), audit=audit)

    def end_maintenance(self) -> list[str]:
        """Put it back in service; returns what was done."""
        state = self.folder / "state"
        file = MaintenanceFile(state)
        if file.read() is None:
            return []
        file.end("a person", Role.ADMIN, AuditLog.in_directory(state))
        return ["back in service"]

    def turn(self) -> dict[str, float]:
        """A long turn of joint 7 from where it is [rad]."""
        position = self.witness.states[-1][1][6]
        return {"fr3_joint7": 2.0 if position < 0 else -2.0}

    def press_topic(self) -> None:
        """Trigger the emergency stop by the topic."""
        from std_msgs.msg import Bool  # heavy

        from roboneuron.ros.qos import NEWEST  # heavy

        if not hasattr(self, "_topic"):
            self._topic = self._link.advertise(Bool, f"/{self._robot}/emergency_stop", NEWEST)
            time.sleep(1.0)  # until it is discovered, because earlier messages are lost
        self._topic(Bool(data=True))
        self.until(
            (self.folder / "state" / ESTOP_FILE).exists, 5.0, "the stop of the topic is latched"
        )

    def cause_fault(self) -> None:
        """Make the arm stop by itself, as with a reflex."""
        if self._sim is None:
            (self.folder / "fault").touch()
        else:
            self._sim.tell(error=REFLEX)

    def release_by_file(self) -> None:
        """Release as `roboneuron estop --reset` does."""
        latch = self.folder / "state" / ESTOP_FILE
        os.replace(latch, latch.with_name(latch.name + RESET_SUFFIX))

    def everything_runs(self) -> None:
        """Start missing modules like an agent, without a new instruction for the policy."""
        for kind in KINDS:
            deadline_s = time.monotonic() + 60.0
            while (phase := self.modules()[kind]["phase"]) in ("starting", "stopping", "exited"):
                time.sleep(0.2)  # a restart may be in progress
                if phase == "exited" and time.monotonic() > deadline_s - 55.0:
                    break
                if time.monotonic() > deadline_s:
                    raise RuntimeError(f"{kind} stays {phase}")
            if phase in ("stopped", "exited") and kind != "inference":
                with contextlib.suppress(RuntimeError):  # may have been restarted automatically
                    self.do(f"start_{kind}")


_LOSSES = ("kill", "freeze", "stop")
_EVERYTHING = (
    "estop_tool",
    "estop_topic",
    "estop_file",
    "estop_signal",
    "fault",
    "maintenance",
    *(f"{how}_{kind}" for how in _LOSSES for kind in ("robot", "control")),
)
_OF_POLICIES = (
    *_EVERYTHING,
    *(
        f"{how}_{kind}"
        for how in ("kill", "freeze", "stop")
        for kind in ("perception", "inference")
    ),
)
STOPS = {
    "set_instruction": _OF_POLICIES,
    "start_inference": _OF_POLICIES,
    "run_task": (*_OF_POLICIES, "cancel"),
    "move_joints": (*_EVERYTHING, "cancel"),
    "publish": (*_EVERYTHING, "cancel"),
    "lead": (*_EVERYTHING, "hand_back"),
}
"""What requests motion, and what has to end it."""
SWITCHES = ("switch_inference", "switch_control", "switch_perception", "switch_inference_cold")


def start(cell: Cell, how: str, instruction: str) -> None:
    """Request motion."""
    running = cell.modules()["inference"]["phase"] == "running"
    if how in ("move_joints", "publish", "lead"):
        if running:
            cell.do("stop_inference")
        if how == "lead":
            cell.do("lead_arm", source="push")
        elif how == "move_joints":
            cell.later("move_joints", positions=cell.turn(), duration_s=8.0)
        else:
            (joint, position), *_ = cell.turn().items()
            point = {"positions": [position], "time_from_start": {"sec": 8, "nanosec": 0}}
            message = {"joint_names": [joint], "points": [point]}
            cell.later("publish_joint_trajectory", message=message)
    elif how == "run_task":
        cell.later("run_task", instruction=instruction, until=NEVER, max_s=60, max_attempts=1)
    elif running and how == "set_instruction":
        cell.do("set_instruction", instruction=instruction)
    else:
        if running:
            cell.do("stop_inference")
        cell.do("start_inference", instruction=instruction)


def stop(cell: Cell, how: str) -> None:
    """Stop motion."""
    if how == "estop_tool":
        cell.ask("emergency_stop", reason="random sequence")
    elif how == "estop_topic":
        cell.press_topic()
    elif how == "estop_file":
        (cell.folder / "state" / ESTOP_FILE).touch()
    elif how == "estop_signal":
        os.kill(cell.do("get_status")["pid"], signal.SIGUSR1)
    elif how == "fault":
        cell.cause_fault()
    elif how.startswith("kill_"):
        cell.kill(how.removeprefix("kill_"))
    elif how.startswith("freeze_"):
        cell.freeze(how.removeprefix("freeze_"))
    elif how == "cancel":
        cell.cancel()
    elif how == "maintenance":
        cell.begin_maintenance()
    else:
        cell.ask(how)


def go_on(cell: Cell, draw: random.Random) -> list[str]:
    """Release, recover and restart everything that is stopped; none of these starts motion."""
    done = cell.resume() + cell.end_maintenance()
    if (cell.folder / "state" / ESTOP_FILE).exists():
        if draw.random() < 0.5:
            # the server reads every 0.2 s that the robot is back in service
            cell.until(
                lambda: not cell.ask("reset_emergency_stop").is_error, 5.0, "the stop is released"
            )
            done.append("reset by tool")
        else:
            cell.release_by_file()
            done.append("reset by file")
    if (cell.folder / "fault").exists():
        (cell.folder / "fault").unlink()
    for _ in range(2):
        answer = (
            cell.ask("recover_robot") if cell.modules()["robot"]["phase"] == "running" else None
        )
        if answer is not None and not answer.is_error:
            done.append("recovered")
    cell.everything_runs()
    if draw.random() < 0.5:
        how = draw.choice(SWITCHES)
        mode = "cold" if how.endswith("_cold") else "warm"
        answer = cell.ask(how.removesuffix("_cold"), mode=mode)
        done.append(f"{how}{' refused' if answer.is_error else ''}")
    return done


@contextlib.contextmanager
def served_cell(folder: Path, engine: str, restart: str, seed: int) -> Iterator[Cell]:
    """A server with all modules running and no instruction; everything ends with it."""
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        sim = None
        if engine == FRANKA_SIM:
            sim = FrankaSim(PYTHON, seed=seed, options=STRICT, log=folder / "franka-sim.log")
            stack.enter_context(sim)
            robot = OVER_FCI.format(host=sim.host)
        else:
            robot = SIMULATED.format(folder=folder, engine=engine, seed=seed)
        path = folder / "roboneuron.toml"
        path.write_text(CONFIG.format(folder=folder, robot=robot, restart=restart))
        plugins = ("new_start_plugin", "lost_plugin") if sim is None else ("fci_plugin",)
        stack.enter_context(installed(folder, "new-start", plugins))
        prepare_environment(folder / "log")
        from roboneuron.ros.link import RosLink  # heavy

        link = RosLink("witness")
        stack.callback(link.close)
        link.open()
        witness = Witness()
        if sim is None:
            witness.watch_topic(link, "fr3r")
        else:
            end = threading.Event()
            watching = threading.Thread(target=witness.watch_simulator, args=(sim, end))
            watching.start()
            stack.callback(watching.join)
            stack.callback(end.set)
        log = stack.enter_context((folder / "server.log").open("a"))
        agent = blocking_client(path, os.environ, "--log-level", "warning", errors=log)
        client, portal = stack.enter_context(agent)
        yield Cell(client, portal, witness, link, folder, sim)
