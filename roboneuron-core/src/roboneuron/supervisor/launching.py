"""The server's ROS node; and from a choice to a process that has proved that it works, and from there to its end."""

from __future__ import annotations

import itertools
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboneuron.config import ServerConfig
from roboneuron.errors import ConfigurationError, NotReadyError, RoboNeuronError, StateError
from roboneuron.modules.settings import ModuleKind, ModuleSettings
from roboneuron.ros.environment import check_state_directory, module_environment, prepare_environment
from roboneuron.ros.topics import DIAGNOSTICS
from roboneuron.supervisor.bringup import Bringup
from roboneuron.supervisor.changes import Changes, Periodic
from roboneuron.supervisor.health import StatusBoard, Stopped
from roboneuron.supervisor.lifecycle import LifecycleClient
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents, end_processes, spawn
from roboneuron.supervisor.slot import Claim, Phase, Slot

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink


_OPEN_TIMEOUT_S = 30.0


class Connection:
    """Opens the link once, on a thread of its own; `link` waits for it.

    Attributes:
        starts: numbers the module processes of one node, for ports of their own.
    """

    def __init__(self, on_status: Callable[[Any], None], log_directory: Path) -> None:
        self._on_status = on_status
        self._log_directory = log_directory
        self._lock = threading.Lock()
        self._opened: Future[RosLink] | None = None
        self._closed = False
        self.starts = itertools.count(os.getpid())

    def begin(self) -> None:
        """Start opening; returns at once, and does nothing the second time."""
        with self._lock:
            if self._closed:
                raise StateError("The server is shutting down.")
            if self._opened is not None:
                return
            self._opened = Future()
            threading.Thread(target=self._open, args=(self._opened,), name="ros-open", daemon=True).start()

    def link(self) -> RosLink:
        """The open link.

        Raises:
            ConfigurationError: the environment mixes two ROS installations.
            StateError: the server is shutting down.
            NotReadyError: joining takes unusually long; it goes on in the background.
        """
        self.begin()
        assert self._opened is not None
        try:
            return self._opened.result(timeout=_OPEN_TIMEOUT_S)
        except FutureTimeoutError as error:
            raise NotReadyError(f"The ROS graph was not joined within {_OPEN_TIMEOUT_S:g} s.", hint="Retry.") from error

    def close(self) -> None:
        """Leave the graph; idempotent."""
        with self._lock:
            self._closed = True
            opened = self._opened
        if opened is not None and opened.exception(timeout=_OPEN_TIMEOUT_S) is None:
            opened.result().close()

    def _open(self, opened: Future[RosLink]) -> None:
        try:
            prepare_environment(self._log_directory / "ros")
            from diagnostic_msgs.msg import DiagnosticArray  # heavy

            from roboneuron.ros.link import RosLink  # heavy
            from roboneuron.ros.qos import STATUS  # heavy

            link = RosLink(f"roboneuron_server_{os.getpid()}")
            link.open()
            link.subscribe(DiagnosticArray, DIAGNOSTICS, self._on_status, STATUS)
        except BaseException as error:  # handed to whoever asks for the link
            opened.set_exception(error)
        else:
            opened.set_result(link)


log = logging.getLogger(__name__)
Stage = Callable[[str], None]
Command = Callable[[str | None], Sequence[str]]
Connect = Callable[[Callable[[Any], None], Path], Connection]
DEACTIVATE_S = 2.0
_BEAT_S = 0.2
"""A module whose server has ended sees the end of stdin. One whose server is frozen, so that nobody could stop the arm,
misses these signs of life on stdin; control holds then."""


def module_command(python: str | None) -> list[str]:
    """How a module process is started; `-P` keeps the working directory out of its import path."""
    return [python or sys.executable, "-u", "-P", "-m", "roboneuron.modules"]


class Launcher:
    """Spawns module processes into slots and ends them; usable from any thread.

    Args:
        state_directory, command, on_change: as `Supervisor`.
        processes: all that are in slots.
        connect: makes the server's node from what receives /diagnostics and the folder for its logs.

    Attributes:
        log_directory: where this server's modules log, one file for each; `<state>/log/<time>-<pid>`.
        process_events, secret_variables: as `Supervisor`.
        board: what the modules report.
        connection: the server's node.
    """

    def __init__(
        self,
        state_directory: Path,
        changes: Changes,
        command: Command,
        on_change: Callable[[ModuleKind], object],
        processes: Callable[[], Iterable[ModuleProcess]],
        connect: Connect = Connection,
    ) -> None:
        self.log_directory = state_directory / "log" / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"
        self.process_events = ProcessEvents()
        self.secret_variables: set[str] = set()
        self.board = StatusBoard(changes)
        self.connection = connect(self.board.receive, self.log_directory)
        self._changes = changes
        self._processes = processes
        self._command = command
        self._on_change = on_change
        self._spawner = ThreadPoolExecutor(max_workers=1, thread_name_prefix="spawner")
        self._heartbeat = Periodic("heartbeat", _BEAT_S, self._beat)

    def close(self) -> None:
        """Leave the ROS graph and end all threads; a process that is still there gets its death signal."""
        self.connection.close()
        self._heartbeat.close()
        self._spawner.shutdown()

    def bring_up(
        self,
        slot: Slot,
        settings: ModuleSettings,
        python: str | None,
        on_stage: Stage,
        absent: Callable[[], Sequence[ModuleKind]],
    ) -> None:
        """Spawn, configure, activate and wait for readiness; a failure ends the process.

        `absent` tells which modules that this one takes inputs from are neither running nor being started.
        """
        deadline_s = time.monotonic() + settings.config.start_timeout_s(settings.kind)
        phase: Phase = "stopped"
        try:
            process = slot.process = self._spawn(slot, settings, python)
            Bringup(slot, process, settings, self.connection.link(), self.board, on_stage, absent).run(deadline_s)
            phase = "running"
        finally:
            try:
                if phase != "running" and slot.process is not None:
                    end_processes([slot.process], settings.config.supervisor.stop_timeout_s)
                    self.board.forget(settings.status_name, slot.process.pid)
            finally:
                slot.settle(phase)  # also when it survives SIGKILL, else nobody could start one again
            if slot.process is not None and slot.process.exit_code is not None:
                self._on_exit(slot, settings, slot.process)  # it died between its proof and here
            self._on_change(slot.kind)

    def finish(self, claims: Sequence[Claim], within_s: float = math.inf) -> list[Stopped]:
        """Silence all in order, then end them together."""
        started_s = time.monotonic()
        share_s = within_s / (len(claims) + 1)
        for claim in claims:
            self._deactivate(claim, min(share_s, DEACTIVATE_S))
        timeout_s = max((claim.settings.config.supervisor.stop_timeout_s for claim in claims), default=0.0)
        left_s = max(share_s, started_s + within_s - time.monotonic())
        killed = end_processes([claim.process for claim in claims], min(timeout_s, left_s))
        return [self._settle(claim, claim.process.pid in killed, started_s) for claim in claims]

    def _beat(self) -> None:
        for process in self._processes():
            process.beat()

    def _spawn(self, slot: Slot, settings: ModuleSettings, python: str | None) -> ModuleProcess:
        command = self._command(python)
        # A plugin has no use for the server's section.
        told = settings.model_copy(update={"config": settings.config.model_copy(update={"server": ServerConfig()})})
        check_state_directory(self.log_directory)
        try:
            spawning = self._spawner.submit(
                spawn,
                settings.node_name,
                command,
                module_environment(python, next(self.connection.starts), self.secret_variables),
                told.model_dump_json(),
                self.log_directory / f"{settings.node_name}.log",
                self.process_events,
            )
            process = spawning.result()
        except OSError as error:
            raise ConfigurationError(
                f"The {settings.kind} process cannot be started with {command[0]!r}: {error.strerror or error}.",
                hint=f"Check `python` in the section [{settings.kind}] of the configuration.",
            ) from error
        self._heartbeat.start()
        log.info("Spawned %s: pid %d.", settings.node_name, process.pid)
        self.board.watch(settings.status_name, process.pid)
        process.reap(lambda ended: self._on_exit(slot, settings, ended))
        return process

    def _on_exit(self, slot: Slot, settings: ModuleSettings, process: ModuleProcess) -> None:
        if slot.note_exit(process):
            log.error("%s is gone: %s", slot.kind, slot.explain_exit())
            self.board.forget(settings.status_name, process.pid)
            self._on_change(slot.kind)

    def _deactivate(self, claim: Claim, most_s: float) -> None:
        """Ask for silence, for at most `most_s`; what does not answer is ended anyway."""
        slot, process, settings = claim
        limit_s = min(most_s, settings.config.supervisor.stop_timeout_s / 2)
        try:
            client = LifecycleClient(
                self.connection.link(),
                f"/{settings.status_name}",
                self._changes,
                lambda: slot.check_alive("being deactivated"),
                process.announce,
            )
            if client.transition("deactivate", limit_s) is None:
                log.warning("%s did not answer `deactivate` within %.1f s.", settings.node_name, limit_s)
        except RoboNeuronError as error:
            log.warning("Deactivating %s: %s", settings.node_name, error)

    def _settle(self, claim: Claim, killed: bool, started_s: float) -> Stopped:
        slot, process, settings = claim
        report = self.board.newest(settings.status_name, process.pid)
        self.board.forget(settings.status_name, process.pid)
        slot.settle("stopped")
        log.info("Stopped %s: pid %d, exit code %s.", slot.kind, process.pid, process.exit_code)
        stopped = Stopped(
            kind=slot.kind,
            pid=process.pid,
            exit_code=process.exit_code if process.exit_code is not None else -9,
            killed=killed,
            took_s=time.monotonic() - started_s,
            report=report,
        )
        self._on_change(slot.kind)
        return stopped
