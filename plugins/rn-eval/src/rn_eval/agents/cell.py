"""The cell of an episode: configuration, state directory, history and operator."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from collections.abc import Mapping, Set
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import anyio

from rn_eval.agents.client import ToolClient
from rn_eval.agents.configuration import configuration_of
from rn_eval.agents.http_tap import ending_with_parent
from rn_eval.agents.record import TimeMode
from rn_eval.agents.tap import end_module, module_pid
from rn_eval.agents.task import AgentScene, InjectedFault
from rn_simulation.ground_truth import SWITCH as TRUTH_SWITCH
from rn_simulation.slip import SWITCH as SLIP_SWITCH
from rn_standard.console.client import spawned_server
from rn_standard.tasks.history import TaskHistory
from roboneuron import NotReadyError
from roboneuron.feature import estop

if TYPE_CHECKING:
    from mcp import Client

_INCIDENT_S = 15.0
_POLL_S = 0.2
_FROZEN = ("silent", "stuck", "stalled")
"""Incident types of list_incidents that mean a suspended process."""
_PERSON_S = 30.0


class EpisodeFolder:
    """Folder of one episode, with all files of its server.

    Attributes:
        state: the server's state directory.
        configuration: its roboneuron.toml.
    """

    def __init__(self, folder: Path, scene: AgentScene, time: TimeMode = "real") -> None:
        """Store the arguments; writes nothing."""
        self._folder, self._scene, self._time = folder, scene, time
        self.state = folder / "state"
        self.configuration = folder / "roboneuron.toml"
        self._latch = estop.EmergencyStopLatch.in_directory(self.state)

    def prepare(self) -> None:
        """Write the configuration, and produce the episode's history.

        Raises:
            NotReadyError: a server failed while producing it.
        """
        scene = self._scene
        text = configuration_of(scene, self.state, self._time)
        self.configuration.write_text(text, encoding="utf-8")
        self.state.mkdir(parents=True, exist_ok=True)
        history = TaskHistory(self.state)
        for past in scene.past:
            history.note(past.instruction, past.outcome, past.reason, model=dict(past.model))
        if scene.incidents:
            anyio.run(self._break_modules, scene.incidents)
        if scene.recorded_note:
            anyio.run(self._record, scene.recorded_note)
        if scene.latched:
            self._latch.latch(who="person at the cell", reason=scene.latched)

    def command(self, port: int = 0) -> list[str]:
        """Command that starts the server: over HTTP on a loopback port, or on stdio with port 0."""
        over = ["--transport", "http", "--port", str(port)] if port else ["--transport", "stdio"]
        options = ["serve", *over, "--config", str(self.configuration), "--log-level", "error"]
        words = [sys.executable, "-P", "-m", "roboneuron.cli.main", *options]
        return ending_with_parent(words) if port else words

    def environment(self) -> dict[str, str]:
        """Environment of the server: that of this process without the simulator's truth; with a
        recorder only if one is needed.
        """
        needs = self._scene.records or self._scene.recorded_note
        return {
            **os.environ,
            "ROBONEURON_RECORDER": "on" if needs else "off",
            TRUTH_SWITCH: "off",
            SLIP_SWITCH: f"{self._scene.slip_after_s:g}" if self._scene.slip_after_s else "",
        }

    def is_latched(self, robot: str = "") -> bool:
        """True if the latch file of a robot or of all robots exists; checks nothing else."""
        own = self.state / "robots" / robot / self._latch.path.name
        return self._latch.path.exists() or (bool(robot) and own.exists())

    def recordings(self) -> tuple[str, ...]:
        """Non-empty recording files, relative to the state directory."""
        files = self.state.rglob("*.mcap")
        return tuple(sorted(str(f.relative_to(self.state)) for f in files if f.stat().st_size))

    def release_as_person(self) -> None:
        """Release the emergency stop as a person at a terminal would.

        Raises:
            NotReadyError: the command was refused.
        """
        person, terminal = pty.openpty()
        try:
            os.write(person, b"y\n")
            words = ["-P", "-m", "roboneuron.cli.main", "estop", "--reset", "--state"]
            done = subprocess.run(
                [sys.executable, *words, str(self.state)],
                stdin=terminal,
                capture_output=True,
                timeout=_PERSON_S,
                check=False,
            )
        finally:
            os.close(person)
            os.close(terminal)
        if done.returncode:
            raise NotReadyError(f"The stop was not released: {done.stderr.decode()[-300:]}")

    async def _break_modules(self, faults: tuple[InjectedFault, ...]) -> None:
        """Start a server, break the modules, and wait until it has recorded the faults."""
        async with self._server() as client:
            tools = ToolClient(client)
            server = int((await tools.must("get_status")).number("pid"))
            await tools.must("start_all")
            for fault in faults:
                known = {str(one["id"]) for one in await incidents(tools)}
                pid = module_pid(server, fault.module)
                if pid is None:
                    raise NotReadyError(f"The module {fault.module} has no process to break.")
                end_module(pid, fault.kind)
                await wait_for_incident(tools, fault, known)
            await tools.must("stop_all")

    async def _record(self, note: str) -> None:
        async with self._server() as client:
            tools = ToolClient(client)
            await tools.must("start_robot")
            await tools.must("start_recording", name="morning", note=note)
            await anyio.sleep(1.0)
            await tools.must("stop_recording", outcome="success")
            await tools.must("stop_all")

    def _server(self) -> AbstractAsyncContextManager[Client]:
        os.environ.update(_changed(os.environ, self.environment()))
        options = ["--config", str(self.configuration), "--log-level", "error"]
        return spawned_server(options, self._folder / "before.log")


async def incidents(tools: ToolClient) -> list[dict[str, object]]:
    """Faults recorded by the server, newest first, without restarts."""
    found = (await tools.must("list_incidents", entries=100)).data["incidents"]
    assert isinstance(found, list)
    return [dict(one) for one in found if one.get("what") != "restart"]


async def wait_for_incident(
    tools: ToolClient, fault: InjectedFault, known: Set[str], within_s: float = _INCIDENT_S
) -> None:
    """Wait until this fault is the newest one recorded. A busy machine causes others: a module may
    stall before it is killed, and another module after that.

    Args:
        tools: tools of the server.
        fault: the fault just caused.
        known: ids of earlier records.
        within_s: longest wait.

    Raises:
        NotReadyError: the fault is not recorded in time, or another module failed after it.
    """
    expected = ("exited",) if fault.kind == "kill" else _FROZEN
    deadline_s = time.monotonic() + within_s
    while True:
        new = [one for one in await incidents(tools) if one["id"] not in known]
        told = [one for one in new if one["module"] == fault.module and one["what"] in expected]
        if told:
            break
        if time.monotonic() >= deadline_s:
            raise NotReadyError(f"The server has recorded no incident of {fault.module}.")
        await anyio.sleep(_POLL_S)
    if new[0]["module"] != fault.module:
        raise NotReadyError(
            f"The newest fault after breaking {fault.module} is not the scene's: "
            f"{new[0]['module']} is {new[0]['what']}."
        )


def _changed(now: Mapping[str, str], wanted: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in wanted.items() if now.get(name) != value}


def end_process(process: subprocess.Popen[bytes], patience_s: float = 3.0) -> None:
    """End a process and its process group, which it leads: first SIGTERM, then SIGKILL."""
    for stop in (15, 9):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, stop)
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
            break
    with suppress(ProcessLookupError):  # processes left in its group
        os.killpg(process.pid, 9)
