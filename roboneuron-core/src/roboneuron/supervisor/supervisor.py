"""Start, monitor and stop module processes; usable from any thread, and every wait is bounded."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.config import ModuleSettings
from roboneuron.errors import ConfigurationError, NotReadyError, RoboNeuronError, StateError
from roboneuron.modules.settings import ARM_KINDS, ModuleKind
from roboneuron.planning import Plan
from roboneuron.ros.environment import check_state_directory, module_environment
from roboneuron.supervisor.bringup import Bringup
from roboneuron.supervisor.changes import Periodic, Stage
from roboneuron.supervisor.connection import Connect, Connection
from roboneuron.supervisor.health import Modules, ModuleView, Stopped
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.process import (
    KILL_S,
    Command,
    ModuleProcess,
    end_processes,
    module_command,
    spawn,
)
from roboneuron.supervisor.slot import Slot

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

log = logging.getLogger(__name__)
DEACTIVATE_S = 2.0
"""Bound on the answer to `deactivate` when a module is stopped; afterwards it is ended in
any case.
"""
_BEAT_S = 0.2
"""Period of signs of life on a module's stdin. A module whose server has ended sees the end of
stdin. If the server is frozen, so that the arm could not be stopped from outside, the signs of life
are missing and control holds.
"""
LEAVE_S = 1.5
"""Time for modules to exit when the server ends, whatever the configuration says about stops: they
are gone within 2 s.
"""


class Supervisor(Modules):
    """Supervisor of at most one process of each kind, and a second one during a replacement.

    Args:
        state_directory: logs go to its `log` folder; modules get it too.
        command: command line of a module for a given interpreter.
        on_change: called from any thread, with the kind, when a module started, stopped or ended by
            itself.
        connect: creates the server's node from the receiver of /diagnostics and the folder for its
            logs.

    Attributes:
        log_directory: `<state>/log/<time>-<pid>`.
        on_join: functions of features, called in modules with their node, as "module:attribute";
            see `ModuleHost`.
        needs_start: the stop after which newly started robot and control modules refuse motion
            until it is requested; empty for none.
        connection: the server's node.
        heartbeat: sends signs of life to the modules.
    """

    def __init__(
        self,
        state_directory: Path,
        *,
        command: Command = module_command,
        on_change: Callable[[ModuleKind], object] = lambda kind: None,
        connect: Connect = Connection,
    ) -> None:
        run = f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"
        super().__init__(state_directory / "log" / run, on_change)
        self.state_directory = state_directory
        self.on_join: tuple[str, ...] = ()
        self.needs_start = ""
        self.connection = connect(self.receive, self.log_directory)
        self._command = command
        # lives as long as the server, because PR_SET_PDEATHSIG follows the thread
        self._spawning = ThreadPoolExecutor(max_workers=1, thread_name_prefix="spawner")
        self.heartbeat = Periodic("heartbeat", _BEAT_S, self._beat)
        self._closed = False

    @property
    def link(self) -> RosLink:
        """The ROS node of the control plane; opened on first use."""
        return self.connection.link()

    def parameters(self, slot: Slot, check: Callable[[], None] = lambda: None) -> NodeClient:
        """Create the client of the node in a slot, which drives it and sets its parameters.

        Args:
            slot: slot of a module.
            check: called while a transition is waited for; raises to give up.

        Raises:
            StateError: its process has ended.
        """
        # read once, because a stop may empty the slot meanwhile
        settings, process = slot.settings, slot.process
        if settings is None or process is None:
            raise StateError(f"{slot.kind} has ended.")
        return NodeClient(
            self.link, self.changes, f"/{settings.status_name}", process.announce, check
        )

    def open(self) -> None:
        """Start joining the ROS graph in the background; returns at once.

        Raises:
            ConfigurationError: the state directory cannot be written.
        """
        check_state_directory(self.state_directory)
        self.connection.begin()

    def start(
        self,
        plan: Plan,
        on_stage: Stage = lambda stage: None,
        beside: Slot | None = None,
        halt: threading.Event | None = None,
    ) -> ModuleView:
        """Spawn, configure, activate, and wait for readiness; a failed start leaves nothing behind.

        Args:
            plan: the module and its options.
            on_stage: called with a phrase at each stage of the start.
            beside: one of `slots` other than the first: the module starts there, as the
                successor of the one that works.
            halt: set when the client cancels its call, which cancels the start.

        Raises:
            StateError: it is already running, or the start was cancelled.
            NotReadyError: it died, or something is missing; the message names it.
            RoboNeuronError: the error that the module itself reports.
        """
        kind = plan.kind
        with self.changes.lock:
            if self._closed:
                raise StateError("The server is shutting down.")
            working = self.slot(kind)
            settings = ModuleSettings(
                kind=kind,
                node_name=kind,
                config=plan.config,
                state_directory=str(self.state_directory),
                tightened=self.tightened,
                needs_start=self.needs_start if kind in ARM_KINDS else "",
                on_join=self.on_join,
            )
            if beside is not None:
                settings = self._as_successor(settings, working)
            slot = beside or working
            slot.begin_start(plan, settings, halt)
        self.heartbeat.start()
        bringup = Bringup(slot, plan, settings, self, self.parameters, on_stage)
        with bringup.settled():
            slot.check_not_cancelled()
            bringup.check_robot()
            bringup.prove(self._spawn(settings))
        return self.view(kind)

    def _spawn(self, settings: ModuleSettings) -> ModuleProcess:
        """Start the process of a module.

        Raises:
            ConfigurationError: it cannot be started, or its log cannot be written.
            NotReadyError: the system does not start it in time; it is ended as soon as it appears.
        """
        section = settings.config.module_section(settings.kind)
        python = None if section is None else section.python
        command = self._command(python)
        check_state_directory(self.log_directory)
        spawning = self._spawning.submit(
            spawn,
            settings.node_name,
            command,
            module_environment(python, next(self.connection.starts), self.secret_variables),
            # plugins have no use for the server's own section
            settings.model_dump_json(exclude={"config": {"server"}}),
            self.log_directory / f"{settings.node_name}.log",
            self.process_events,
        )
        limit_s = settings.config.start_timeout_s(settings.kind)
        try:
            process = spawning.result(limit_s)
        except TimeoutError as error:
            spawning.add_done_callback(_end_late)
            raise NotReadyError(
                f"The {settings.kind} process was not started within {limit_s:g} s.",
                hint=f"Does the file system of {command[0]!r} answer?",
            ) from error
        except OSError as error:
            raise ConfigurationError(
                f"The {settings.kind} process cannot be started with {command[0]!r}: "
                f"{error.strerror or error}.",
                hint=f"Check `python` in the section [{settings.kind}] of the configuration.",
            ) from error
        log.info("Spawned %s: pid %d.", process.name, process.pid)
        with self.changes.lock:
            self._ours.add(str(process.pid))
        return process

    def _as_successor(self, settings: ModuleSettings, working: Slot) -> ModuleSettings:
        """Settings of the successor of the module in `working`, with the other one of two node
        names, and subject to the same stop.
        """
        kind, report = settings.kind, working.report
        is_named_so = working.settings is not None and working.settings.node_name == kind
        changes: dict[str, object] = {
            "is_successor": True,
            "node_name": f"{kind}_b" if is_named_so else kind,
        }
        # newer than the server's count: a module may have seen a stop before the server
        if report is not None and kind in ARM_KINDS:
            changes["needs_start"] = report.needs_start
        return settings.model_copy(update=changes)

    def stop(self, kind: ModuleKind) -> Stopped:
        """Deactivate, end and reap a module; a start in progress is cancelled instead.

        Raises:
            StateError: it is not running.
        """
        reason = f"stop_{kind} was called."
        with self.changes.lock:
            slot, *others = self.slots[kind]
        for other in others:
            other.cancel(reason)
        if slot.cancel(reason):
            self._await_settled(slot)
            if slot.phase != "running":
                return Stopped(module=kind, cancelled_start=True)
        return self.end(slot)

    def end(self, slot: Slot) -> Stopped:
        """Deactivate, end and reap the module in one of `slots`.

        Args:
            slot: also one that is about to replace another, or was replaced.

        Raises:
            StateError: it is not running.
        """
        return self._finish({slot: slot.begin_stop()})[0]

    def stop_all(self, within_s: float = math.inf) -> list[Stopped]:
        """Stop everything in the reverse order of starting; never raises for what is not running.

        Args:
            within_s: upper bound on the time before a kill, if `supervisor.stop_timeout_s` is
                longer.
        """
        slots = self.all_slots()
        for slot in slots:
            if slot.cancel("everything is being stopped."):
                self._await_settled(slot)
        claimed: dict[Slot, ModuleProcess] = {}
        for slot in sorted(slots, key=lambda s: -s.started_s):
            # it has ended, or another thread has begun to stop it
            with suppress(StateError):
                claimed[slot] = slot.begin_stop()
        return self._finish(claimed, within_s)

    def close(self) -> None:
        """Stop everything, leave the ROS graph, end all threads; idempotent.

        The order matters: modules are deactivated over ROS, the heartbeat continues until they are
        gone so that none regards its server as frozen, and the spawning thread ends last.
        """
        with self.changes.lock:
            self._closed = True
        self.stop_all(LEAVE_S)
        self.connection.close()
        self.heartbeat.close()
        self._spawning.shutdown()  # a process that is still alive gets its death signal

    def _finish(
        self, claimed: Mapping[Slot, ModuleProcess], within_s: float = math.inf
    ) -> list[Stopped]:
        """Deactivate all modules in order, then end them together.

        Deactivation comes first, so that control holds the arm before any process is ended. Each
        gets an equal share of the time; the rest is left for the ends.

        Args:
            claimed: processes by their slots, in the order of deactivation.
            within_s: bound on all of it [s].
        """
        started_s = time.monotonic()
        share_s = within_s / (len(claimed) + 1)
        for slot, process in claimed.items():
            self._deactivate(slot, process, min(share_s, DEACTIVATE_S))
        timeout_s = max((slot.stop_timeout_s for slot in claimed), default=0.0)
        left_s = max(share_s, started_s + within_s - time.monotonic())
        killed = end_processes(list(claimed.values()), min(timeout_s, left_s))
        return [
            self._settle(slot, process, process.pid in killed, started_s)
            for slot, process in claimed.items()
        ]

    def _deactivate(self, slot: Slot, process: ModuleProcess, most_s: float) -> None:
        """Request deactivation, for at most `most_s`; a module that does not answer is ended
        anyway.
        """
        limit_s = min(most_s, slot.stop_timeout_s / 2)
        try:
            client = self.parameters(slot, lambda: slot.check_alive("being deactivated"))
            if client.transition("deactivate", limit_s) is None:
                log.warning("%s did not answer `deactivate` within %.1f s.", process.name, limit_s)
        except RoboNeuronError as error:
            log.warning("Deactivating %s: %s", process.name, error)

    def _settle(
        self, slot: Slot, process: ModuleProcess, killed: bool, started_s: float
    ) -> Stopped:
        """Free the slot of an ended module; return the result of the stop.

        Args:
            slot, process: what was ended.
            killed: it needed SIGKILL.
            started_s: time at which the stop began [monotonic s].
        """
        report = slot.report
        slot.settle("stopped")
        log.info("Stopped %s: pid %d, exit code %s.", slot.kind, process.pid, process.exit_code)
        stopped = Stopped(
            module=slot.kind,
            pid=process.pid,
            exit_code=process.exit_code if process.exit_code is not None else -9,
            killed=killed,
            took_s=round(time.monotonic() - started_s, 3),
            report=report,
        )
        self.on_change(slot.kind)
        return stopped

    def _beat(self) -> None:
        for slot in self.all_slots():
            if (process := slot.process) is not None:
                process.beat()

    def _await_settled(self, slot: Slot) -> None:
        """Wait for the end of a cancelled start: its thread ends the process, which takes as long
        as any stop, and a second more.
        """
        slot.await_settled(slot.stop_timeout_s + KILL_S + 1.0)


def _end_late(spawning: Future[ModuleProcess]) -> None:
    """Kill a process that started too late; a failed start is ignored."""
    if spawning.exception() is None:
        process = spawning.result()
        process.reap(lambda ended: None)
        process.kill()
