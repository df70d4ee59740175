"""From a choice to a process that has proved that it works, and from there to its end."""

from __future__ import annotations

import itertools
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from roboneuron.config import ServerConfig
from roboneuron.errors import ConfigurationError
from roboneuron.modules.priority import lower
from roboneuron.modules.settings import ModuleKind, ModuleSettings
from roboneuron.ros.environment import check_state_directory, module_environment
from roboneuron.supervisor.bringup import Bringup
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.connection import Connection
from roboneuron.supervisor.ending import DEACTIVATE_S, deactivate, end_processes
from roboneuron.supervisor.health import Report, StatusBoard
from roboneuron.supervisor.observing import ProcessObservers
from roboneuron.supervisor.process import ModuleProcess, Spawner
from roboneuron.supervisor.slot import Phase, Slot
from roboneuron.supervisor.view import Stopped

log = logging.getLogger(__name__)
Stage = Callable[[str], None]
Command = Callable[[str | None], Sequence[str]]


def module_command(python: str | None) -> list[str]:
    """How a module process is started; `-P` keeps the working directory out of its import path."""
    return [python or sys.executable, "-u", "-P", "-m", "roboneuron.modules"]


class Launcher:
    """Spawns module processes into slots and ends them; usable from any thread.

    Args:
        command: how to start a module under a given interpreter.
        log_directory: one file for each module.
        on_spawn: called after each spawn.
        on_change: called with the kind when a module started, stopped or ended by itself.
        observers: told of every process.
        secret_variables: environment variables that modules do not get.
    """

    def __init__(
        self,
        connection: Connection,
        board: StatusBoard,
        changes: Changes,
        *,
        command: Command,
        log_directory: Path,
        on_spawn: Callable[[], None],
        on_change: Callable[[ModuleKind], object],
        observers: ProcessObservers,
        secret_variables: Collection[str],
    ) -> None:
        self._connection = connection
        self._board = board
        self._changes = changes
        self._command = command
        self._log_directory = log_directory
        self._on_spawn = on_spawn
        self._on_change = on_change
        self._secret_variables = secret_variables
        self._spawner = Spawner(observers)
        self._starts = itertools.count(os.getpid())

    def close(self) -> None:
        """End the spawning thread; what it started gets its death signal."""
        self._spawner.close()

    def report_of(self, slot: Slot) -> Report | None:
        """The newest report of the process in a slot."""
        process, choice = slot.process, slot.choice
        if process is None or choice is None:
            return None
        return self._board.newest(choice.settings.status_name, process.pid)

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
        supervision = settings.config.supervisor
        deadline_s = time.monotonic() + settings.config.start_timeout_s(settings.kind)
        phase: Phase = "stopped"
        try:
            slot.process = self._spawn(slot, settings, python)
            bringup = Bringup(
                slot, slot.process, settings, self._connection.link(), self._board, self._changes, on_stage, absent
            )
            bringup.run(deadline_s)
            phase = "running"
        finally:
            try:
                if phase != "running" and slot.process is not None:
                    end_processes([slot.process], supervision.stop_timeout_s)
                    self._board.forget(settings.status_name, slot.process.pid)
            finally:
                slot.settle(phase)  # also when it survives SIGKILL, else nobody could start one again
            if slot.process is not None and slot.process.exit_code is not None:
                self._on_exit(slot, settings, slot.process)  # it died between its proof and here
            self._on_change(slot.kind)

    def _spawn(self, slot: Slot, settings: ModuleSettings, python: str | None) -> ModuleProcess:
        command = self._command(python)
        # A plugin has no use for the server's section.
        told = settings.model_copy(update={"config": settings.config.model_copy(update={"server": ServerConfig()})})
        check_state_directory(self._log_directory)
        try:
            process = self._spawner.spawn(
                settings.node_name,
                command,
                module_environment(python, next(self._starts), self._secret_variables),
                told.model_dump_json(),
                self._log_directory / f"{settings.node_name}.log",
            )
        except OSError as error:
            raise ConfigurationError(
                f"The {settings.kind} process cannot be started with {command[0]!r}: {error.strerror or error}.",
                hint=f"Check `python` in the section [{settings.kind}] of the configuration.",
            ) from error
        if settings.shadow:
            lower(process.pid)
        self._on_spawn()
        log.info("Spawned %s: pid %d.", settings.node_name, process.pid)
        self._board.watch(settings.status_name, process.pid)
        process.reap(lambda ended: self._on_exit(slot, settings, ended))
        return process

    def _on_exit(self, slot: Slot, settings: ModuleSettings, process: ModuleProcess) -> None:
        if slot.note_exit(process):
            log.error("%s is gone: %s", slot.kind, slot.explain_exit())
            self._board.forget(settings.status_name, process.pid)
            self._on_change(slot.kind)

    def finish(self, claimed: Sequence[tuple[Slot, ModuleProcess]], within_s: float = math.inf) -> list[Stopped]:
        """Silence all in order, then end them together."""
        started_s = time.monotonic()
        share_s = within_s / (len(claimed) + 1)
        choices = [slot.choice for slot, _ in claimed]
        timeout_s = 0.0
        for (slot, _), choice in zip(claimed, choices, strict=True):
            if choice is not None:
                timeout_s = max(timeout_s, choice.settings.config.supervisor.stop_timeout_s)
                deactivate(self._connection.link(), self._changes, slot, choice.settings, min(share_s, DEACTIVATE_S))
        left_s = max(share_s, started_s + within_s - time.monotonic())
        killed = end_processes([process for _, process in claimed], min(timeout_s, left_s))
        results = []
        for (slot, process), choice in zip(claimed, choices, strict=True):
            report = self.report_of(slot)
            if choice is not None:
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
