"""Starts, watches and stops module processes; usable from any thread, and every wait has a bound."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.config import Config
from roboneuron.errors import ConfigurationError, StateError
from roboneuron.modules.priority import lower
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind, ModuleSettings
from roboneuron.ros.environment import module_environment
from roboneuron.supervisor.bringup import Bringup
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.connection import Connection
from roboneuron.supervisor.ending import DEACTIVATE_S, KILL_S, deactivate, end_processes
from roboneuron.supervisor.health import Report, StatusBoard
from roboneuron.supervisor.heartbeat import Heartbeat
from roboneuron.supervisor.logs import run_directory
from roboneuron.supervisor.process import ModuleProcess, Spawner
from roboneuron.supervisor.slot import Choice, Phase, Slot
from roboneuron.supervisor.view import ModuleView, Stopped

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

log = logging.getLogger(__name__)
Stage = Callable[[str], None]
_LEAVE_S = 1.5
"""When the server ends, whatever the configuration says about stops: its modules are gone within 2 s."""


def module_command(python: str | None) -> list[str]:
    """How a module process is started; `-P` keeps the working directory out of its import path."""
    return [python or sys.executable, "-u", "-P", "-m", "roboneuron.modules"]


def _ignore(_: str) -> None:
    """No listener."""


class Supervisor:
    """At most one process of each kind, and a second one while it is being replaced.

    Args:
        state_directory: logs go to its `log` folder, and modules are told it.
        command: how to start a module under a given interpreter.
        on_change: called from any thread, with the kind, when a module started, stopped or ended by itself.
    """

    def __init__(
        self,
        state_directory: Path,
        *,
        command: Callable[[str | None], Sequence[str]] = module_command,
        on_change: Stage = _ignore,
    ) -> None:
        self.state_directory = state_directory
        self.log_directory = run_directory(state_directory)
        self.changes = Changes()
        self._command = command
        self._on_change = on_change
        self._board = StatusBoard(self.changes)
        self._connection = Connection(self._board.receive, self.log_directory)
        self._spawner = Spawner()
        self._heartbeat = Heartbeat(self._processes)
        self._slots = {kind: Slot(kind, self.changes) for kind in MODULE_KINDS}
        self._beside: list[Slot] = []
        self._order = count(1)
        self._closed = False

    @property
    def link(self) -> RosLink:
        """The ROS node of the control plane; opened on first use."""
        return self._connection.link()

    def open(self) -> None:
        """Begin to join the ROS graph in the background; returns at once."""
        self._connection.begin()

    def start(
        self,
        kind: ModuleKind,
        config: Config,
        *,
        python: str | None = None,
        names: Mapping[str, str] | None = None,
        on_stage: Stage = _ignore,
    ) -> ModuleView:
        """Spawn, configure, activate, and wait for the proof that it works; a failing start leaves nothing behind.

        Args:
            kind: which module.
            config: the effective configuration it is told.
            python: interpreter of its own environment.
            names: what was chosen, for messages.
            on_stage: called with a phrase whenever the start has come further.

        Raises:
            StateError: it is already there, or the start was cancelled.
            NotReadyError: it died, or something is missing; the message names it.
            RoboNeuronError: what the module itself says is wrong.
        """
        slot = self._slots[kind]
        with self.changes.lock:
            self._check_open()
            settings = self._settings(kind, kind, config)
            slot.begin_start(Choice(settings=settings, names=names or {}), next(self._order))
        self._bring_up(slot, settings, python, on_stage)
        return self.view(kind)

    def start_standby(
        self,
        kind: ModuleKind,
        config: Config,
        *,
        python: str | None = None,
        names: Mapping[str, str] | None = None,
        on_stage: Stage = _ignore,
    ) -> Slot:
        """Start a second process beside the running one, in shadow; `adopt` or `discard` it.

        Raises:
            StateError: nothing of that kind runs, or there is a standby already.
            RoboNeuronError: as `start`.
        """
        standby = Slot(kind, self.changes)
        with self.changes.lock:
            self._check_open()
            active = self._slots[kind]
            if active.phase != "running" or active.choice is None:
                raise StateError(f"{kind} is not running (it is {active.phase}).", hint=f"Call start_{kind} first.")
            if any(other.kind == kind for other in self._beside):
                raise StateError(f"{kind} is already being replaced.", hint="Wait for the end of that call.")
            name = kind if active.choice.settings.node_name != kind else f"{kind}_b"
            settings = self._settings(kind, name, config, shadow=True)
            standby.begin_start(Choice(settings=settings, names=names or {}), next(self._order))
            self._beside.append(standby)
        try:
            self._bring_up(standby, settings, python, on_stage)
        except BaseException:
            self._forget_beside(standby)
            raise
        return standby

    def adopt(self, standby: Slot) -> Slot:
        """Make the standby the module of its kind; returns the old one, which is to be discarded.

        Raises:
            StateError: the old one is being stopped, or the standby is gone.
        """
        with self.changes.lock:
            old = self._slots[standby.kind]
            if old.phase != "running":
                raise StateError(f"{standby.kind} is {old.phase} now; nothing was replaced.")
            if standby.phase != "running":
                raise StateError(f"The new {standby.kind} is gone: {standby.explain_exit()}")
            self._slots[standby.kind] = standby
            self._beside[self._beside.index(standby)] = old
        self._on_change(standby.kind)
        return old

    def discard(self, slot: Slot) -> Stopped | None:
        """End a standby or a replaced module; None when its process was gone already."""
        try:
            process = slot.begin_stop()
            return self._finish([(slot, process)])[0]
        except StateError:
            return None
        finally:
            self._forget_beside(slot)

    def slot(self, kind: ModuleKind) -> Slot:
        """The slot of the module that works now; another one after `adopt`."""
        with self.changes.lock:
            return self._slots[kind]

    def beside(self, kind: ModuleKind) -> list[Slot]:
        """A module that is about to take over, or has been replaced and is leaving."""
        with self.changes.lock:
            return [slot for slot in self._beside if slot.kind == kind]

    def report_of(self, slot: Slot) -> Report | None:
        """The newest report of a module, standby or not."""
        process, choice = slot.process, slot.choice
        if process is None or choice is None:
            return None
        return self._board.newest(choice.settings.status_name, process.pid)

    def stop(self, kind: ModuleKind) -> Stopped | None:
        """Deactivate, end and reap a module; a start in progress is cancelled instead, and None is returned.

        Raises:
            StateError: it is not running.
        """
        slot = self._slots[kind]
        self._cancel_beside(kind, f"stop_{kind} was called.")
        if slot.cancel(f"stop_{kind} was called."):
            self._await_settled(slot)
            if slot.phase != "running":
                return None
        process = slot.begin_stop()
        return self._finish([(slot, process)])[0]

    def cancel(self, kind: ModuleKind, reason: str) -> bool:
        """End a start in progress, without waiting for its end; returns whether there was one."""
        return self._cancel_beside(kind, reason) or self._slots[kind].cancel(reason)

    def stop_all(self, within_s: float = math.inf) -> list[Stopped]:
        """Stop everything in the reverse order of starting; never raises for what is not running.

        Args:
            within_s: kill what has not left by then, where `supervisor.stop_timeout_s` would give it more time.
        """
        with self.changes.lock:
            slots = [*self._slots.values(), *self._beside]
        for slot in slots:
            if slot.cancel("everything is being stopped."):
                self._await_settled(slot)
        claimed: list[tuple[Slot, ModuleProcess]] = []
        for slot in sorted(slots, key=lambda s: -s.order):
            try:
                claimed.append((slot, slot.begin_stop()))
            except StateError:
                continue
        return self._finish(claimed, within_s)

    def view(self, kind: ModuleKind) -> ModuleView:
        """What is known of a module now."""
        with self.changes.lock:
            slot = self._slots[kind]
            report = self.report_of(slot)
            return ModuleView(
                kind=kind,
                phase=slot.phase,
                process=slot.process,
                choice=slot.choice,
                report=report if slot.phase != "exited" else None,
                exit=slot.exit,
            )

    def views(self) -> list[ModuleView]:
        """All modules, in the order robot, perception, inference, control."""
        return [self.view(kind) for kind in MODULE_KINDS]

    def require_running(self, kind: ModuleKind) -> ModuleView:
        """The view of a running module.

        Raises:
            StateError: it is not running; the message says why and what to do.
        """
        view = self.view(kind)
        if view.phase == "exited":
            raise StateError(f"{kind} is not running: {self._slots[kind].explain_exit()}", hint=f"Call start_{kind}.")
        if view.phase != "running":
            raise StateError(f"{kind} is not running (it is {view.phase}).", hint=f"Call start_{kind} first.")
        return view

    def log_path(self, kind: ModuleKind) -> Path:
        """Where the present module of that kind logs."""
        choice = self._slots[kind].choice
        return self.log_directory / f"{choice.settings.node_name if choice is not None else kind}.log"

    def close(self) -> None:
        """Stop everything, leave the ROS graph, end all threads; idempotent."""
        with self.changes.lock:
            self._closed = True
        self.stop_all(_LEAVE_S)
        self._connection.close()
        self._heartbeat.close()
        self._spawner.close()

    def _settings(self, kind: ModuleKind, name: str, config: Config, *, shadow: bool = False) -> ModuleSettings:
        return ModuleSettings(
            kind=kind, node_name=name, config=config, state_directory=str(self.state_directory), shadow=shadow
        )

    def _processes(self) -> list[ModuleProcess]:
        with self.changes.lock:
            slots = [*self._slots.values(), *self._beside]
        return [slot.process for slot in slots if slot.process is not None]

    def _check_open(self) -> None:
        if self._closed:
            raise StateError("The server is shutting down.")

    def _cancel_beside(self, kind: ModuleKind, reason: str) -> bool:
        with self.changes.lock:
            cancelled = [slot.cancel(reason) for slot in self._beside if slot.kind == kind]
        return any(cancelled)

    def _forget_beside(self, slot: Slot) -> None:
        with self.changes.lock:
            if slot in self._beside:
                self._beside.remove(slot)

    def _bring_up(self, slot: Slot, settings: ModuleSettings, python: str | None, on_stage: Stage) -> None:
        """Spawn, configure, activate and wait for readiness; a failure ends the process."""
        supervision = settings.config.supervisor
        deadline_s = time.monotonic() + settings.config.start_timeout_s(settings.kind)
        phase: Phase = "stopped"
        try:
            slot.process = self._spawn(slot, settings, python)
            bringup = Bringup(slot, slot.process, settings, self.link, self._board, self.changes, on_stage)
            bringup.run(deadline_s)
            self._connection.segments.add(slot.process.note_segments())
            phase = "running"
        finally:
            if phase != "running" and slot.process is not None:
                end_processes([slot.process], supervision.stop_timeout_s)
                self._board.forget(settings.status_name, slot.process.pid)
            slot.settle(phase)
            if slot.process is not None and slot.process.exit_code is not None:
                self._on_exit(slot, settings, slot.process)  # it died between its proof and here
            self._on_change(slot.kind)

    def _spawn(self, slot: Slot, settings: ModuleSettings, python: str | None) -> ModuleProcess:
        command = self._command(python)
        try:
            process = self._spawner.spawn(
                settings.node_name,
                command,
                module_environment(python),
                settings.model_dump_json(),
                self.log_directory / f"{settings.node_name}.log",
            )
        except OSError as error:
            raise ConfigurationError(
                f"The {settings.kind} process cannot be started with {command[0]!r}: {error.strerror or error}.",
                hint=f"Check `python` in the section [{settings.kind}] of the configuration.",
            ) from error
        if settings.shadow:
            lower(process.pid)
        self._heartbeat.start()
        log.info("Spawned %s: pid %d.", settings.node_name, process.pid)
        self._board.watch(settings.status_name, process.pid)
        process.reap(lambda ended: self._on_exit(slot, settings, ended))
        return process

    def _on_exit(self, slot: Slot, settings: ModuleSettings, process: ModuleProcess) -> None:
        if slot.note_exit(process):
            log.error("%s is gone: %s", slot.kind, slot.explain_exit())
            self._board.forget(settings.status_name, process.pid)
            self._on_change(slot.kind)

    def _finish(self, claimed: Sequence[tuple[Slot, ModuleProcess]], within_s: float = math.inf) -> list[Stopped]:
        """Silence all in order, then end them together."""
        started_s = time.monotonic()
        share_s = within_s / (len(claimed) + 1)
        choices = [slot.choice for slot, _ in claimed]
        timeout_s = 0.0
        for (slot, _), choice in zip(claimed, choices, strict=True):
            if choice is not None:
                timeout_s = max(timeout_s, choice.settings.config.supervisor.stop_timeout_s)
                deactivate(self.link, self.changes, slot, choice.settings, min(share_s, DEACTIVATE_S))
        left_s = max(share_s, started_s + within_s - time.monotonic())
        killed = end_processes([process for _, process in claimed], min(timeout_s, left_s))
        results = []
        for (slot, process), choice in zip(claimed, choices, strict=True):
            report = None
            if choice is not None:
                report = self._board.newest(choice.settings.status_name, process.pid)
                self._board.forget(choice.settings.status_name, process.pid)
            slot.settle("stopped")
            log.info("Stopped %s: pid %d, exit code %s.", slot.kind, process.pid, process.exit_code)
            results.append(
                Stopped(
                    kind=slot.kind,
                    pid=process.pid,
                    exit_code=process.exit_code if process.exit_code is not None else -9,
                    killed=process.pid in killed,
                    took_s=time.monotonic() - started_s,
                    report=report,
                )
            )
            self._on_change(slot.kind)
        return results

    def _await_settled(self, slot: Slot) -> None:
        config = slot.choice.settings.config.supervisor if slot.choice is not None else None
        bound_s = (config.stop_timeout_s if config else 0.0) + KILL_S + 1.0
        self.changes.wait_for(lambda: slot.phase != "starting", bound_s)
