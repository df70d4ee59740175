"""Starts, watches and stops module processes; usable from any thread, and every wait has a bound."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.config import Config
from roboneuron.errors import StateError
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind, ModuleSettings
from roboneuron.planning import Plan
from roboneuron.ros.environment import check_state_directory
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.connection import Connection
from roboneuron.supervisor.ending import KILL_S
from roboneuron.supervisor.health import Report, StatusBoard
from roboneuron.supervisor.heartbeat import Heartbeat
from roboneuron.supervisor.launching import Command, Launcher, Stage, module_command
from roboneuron.supervisor.logs import run_directory
from roboneuron.supervisor.observing import ProcessObservers
from roboneuron.supervisor.parameters import ParameterClient
from roboneuron.supervisor.process import ModuleProcess
from roboneuron.supervisor.slot import Choice, Slot
from roboneuron.supervisor.view import ModuleView, Stopped

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

_LEAVE_S = 1.5
"""When the server ends, whatever the configuration says about stops: its modules are gone within 2 s."""


def _ignore(_: str) -> None:
    """No listener."""


class Supervisor:
    """At most one process of each kind, and a second one while it is being replaced.

    Args:
        state_directory: logs go to its `log` folder, and modules are told it.
        command: how to start a module under a given interpreter.
        on_change: called from any thread, with the kind, when a module started, stopped or ended by itself.

    Attributes:
        observers: told of every module process.
        on_join: what modules call once they have joined ROS, as "module:attribute".
        secret_variables: environment variables that modules do not get.
    """

    def __init__(
        self,
        state_directory: Path,
        *,
        command: Command = module_command,
        on_change: Callable[[ModuleKind], object] = _ignore,
    ) -> None:
        self.state_directory = state_directory
        self.log_directory = run_directory(state_directory)
        self.changes = Changes()
        self.observers = ProcessObservers()
        self.on_join: tuple[str, ...] = ()
        self.secret_variables: set[str] = set()
        board = StatusBoard(self.changes)
        self._connection = Connection(board.receive, self.log_directory)
        self._heartbeat = Heartbeat(self._processes)
        self._launcher = Launcher(
            self._connection,
            board,
            self.changes,
            command=command,
            log_directory=self.log_directory,
            on_spawn=self._heartbeat.start,
            on_change=on_change,
            observers=self.observers,
            secret_variables=self.secret_variables,
        )
        self._on_change = on_change
        self._slots = {kind: Slot(kind, self.changes) for kind in MODULE_KINDS}
        self._beside: list[Slot] = []
        self._order = count(1)
        self._closed = False

    @property
    def link(self) -> RosLink:
        """The ROS node of the control plane; opened on first use."""
        return self._connection.link()

    def parameters(self, node: str, process: ModuleProcess) -> ParameterClient:
        """The parameters of a module: the absolute name of its node, and its process."""
        return ParameterClient(self.link, self.changes, node, process.announce)

    def open(self) -> None:
        """Begin to join the ROS graph in the background; returns at once.

        Raises:
            ConfigurationError: the state directory cannot be written.
        """
        check_state_directory(self.state_directory)
        self._connection.begin()

    def start(
        self,
        kind: ModuleKind,
        config: Config,
        *,
        python: str | None = None,
        names: Mapping[str, str] | None = None,
        plan: Plan | None = None,
        on_stage: Stage = _ignore,
    ) -> ModuleView:
        """Spawn, configure, activate, and wait for the proof that it works; a failing start leaves nothing behind.

        Args:
            kind: which module.
            config: the effective configuration it is told.
            python: interpreter of its own environment.
            names: what was chosen, for messages.
            plan: the descriptors behind these names.
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
            slot.begin_start(Choice(settings=settings, names=names or {}, plan=plan), next(self._order))
        self._launcher.bring_up(slot, settings, python, on_stage, lambda: self._absent(kind, plan))
        return self.view(kind)

    def start_standby(
        self,
        kind: ModuleKind,
        config: Config,
        *,
        python: str | None = None,
        names: Mapping[str, str] | None = None,
        plan: Plan | None = None,
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
            standby.begin_start(Choice(settings=settings, names=names or {}, plan=plan), next(self._order))
            self._beside.append(standby)
        try:
            self._launcher.bring_up(standby, settings, python, on_stage, lambda: self._absent(kind, plan))
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
            return self._launcher.finish([(slot, process)])[0]
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
        return self._launcher.report_of(slot)

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
        return self._launcher.finish([(slot, process)])[0]

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
        return self._launcher.finish(claimed, within_s)

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
        self._launcher.close()

    def _absent(self, kind: ModuleKind, plan: Plan | None) -> list[ModuleKind]:
        """Modules that one of `kind` takes inputs from and that are neither running nor being started."""
        sources: dict[ModuleKind, tuple[ModuleKind, ...]] = {"control": ("robot",), "inference": ("perception",)}
        needed = sources.get(kind, ())
        if kind == "inference" and plan is not None and plan.backend is not None and plan.backend.needs_state:
            needed = ("robot", "perception", "control")
        return [other for other in needed if self._slots[other].phase not in ("starting", "running")]

    def _settings(self, kind: ModuleKind, name: str, config: Config, *, shadow: bool = False) -> ModuleSettings:
        return ModuleSettings(
            kind=kind,
            node_name=name,
            config=config,
            state_directory=str(self.state_directory),
            shadow=shadow,
            on_join=self.on_join,
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

    def _await_settled(self, slot: Slot) -> None:
        config = slot.choice.settings.config.supervisor if slot.choice is not None else None
        bound_s = (config.stop_timeout_s if config else 0.0) + KILL_S + 1.0
        self.changes.wait_for(lambda: slot.phase != "starting", bound_s)
