"""The closed loop as the agent operates it: choose, start, steer, switch, stop. Calls block; any thread may call."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from roboneuron.config import Config
from roboneuron.errors import RefusedError, StateError
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.server.emergency import EmergencyStop
from roboneuron.server.instructing import instruct
from roboneuron.server.neighbours import check_cameras, check_same_commands
from roboneuron.server.plugins import PluginCatalogue
from roboneuron.server.replacing import Replacing, Switched, SwitchMode
from roboneuron.server.selection import (
    InferenceRequest,
    Options,
    Selection,
    check_instruction,
    select_control,
    select_inference,
    select_perception,
    select_robot,
)
from roboneuron.server.stream import ActionStream
from roboneuron.server.trials import ControlTrial, InferenceTrial, PerceptionTrial
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.launching import Stage
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.supervisor.view import ModuleView, Stopped

if TYPE_CHECKING:
    from roboneuron.plugins.specs import RobotSpec


class ClosedLoop:
    """One robot and the modules around it."""

    def __init__(self, config: Config, plugins: PluginCatalogue, supervisor: Supervisor) -> None:
        self.base = config
        self.plugins = plugins
        self.supervisor = supervisor
        self.emergency_stop = EmergencyStop(supervisor)
        self.on_stop: Callable[[ModuleKind], object] = lambda kind: None
        self._replacing = Replacing(supervisor, self._start)
        self._streams: dict[str, ActionStream] = {}
        self._lock = threading.Lock()

    @property
    def config(self) -> Config:
        """The configuration with the robot that is running, or the configured one."""
        choice = self.supervisor.view("robot").choice
        return self.base if choice is None else choice.settings.config.model_copy(update=self._base_sections())

    def robot_spec(self) -> RobotSpec:
        """Descriptor of the present robot."""
        return self.plugins.current().get("robot", self.config.robot.name)

    def camera_roles(self) -> dict[str, str]:
        """Camera name -> role of the present robot; empty when its plugin is gone."""
        spec = self.plugins.current().specs("robot").get(self.config.robot.name)
        return {} if spec is None else {camera.name: camera.role for camera in spec.cameras}

    def start_robot(
        self, robot: str | None, driver: str | None, options: Options, on_stage: Stage, role: str = ""
    ) -> ModuleView:
        """Start a robot for a client with `role`. Raises as `select_robot` and `Supervisor.start`."""
        selection = select_robot(self.base, self.plugins.current(), robot, driver, options, role)
        namespace = selection.config.namespace
        for view in self.supervisor.views():
            if view.choice is not None and view.choice.settings.config.namespace != namespace:
                raise StateError(
                    f"{view.kind} works for the robot in /{view.choice.settings.config.namespace}, "
                    f"not for {selection.config.robot.name!r}.",
                    hint="Call stop_all first.",
                )
        return self._start("robot", selection, on_stage)

    def start_perception(
        self, source: str | None, cameras: tuple[str, ...], options: Options, on_stage: Stage, role: str = ""
    ) -> ModuleView:
        """Start the cameras. Raises as `select_perception` and `Supervisor.start`."""
        selection = select_perception(self.config, self.plugins.current(), source, cameras, options, role)
        return self._start("perception", selection, on_stage)

    def start_control(self, controller: str | None, options: Options, on_stage: Stage, role: str = "") -> ModuleView:
        """Start the controller. Raises as `select_control` and `Supervisor.start`."""
        selection = select_control(self.config, self.plugins.current(), controller, options, role)
        return self._start("control", selection, on_stage)

    def start_inference(self, request: InferenceRequest, on_stage: Stage, role: str = "") -> ModuleView:
        """Start a backend. Raises as `select_inference` and `Supervisor.start`."""
        selection = self._select_inference(request, role)
        self._check_may_move(selection)
        return self._start("inference", selection, on_stage)

    def switch_inference(
        self, request: InferenceRequest, mode: SwitchMode, on_stage: Stage, role: str = ""
    ) -> Switched:
        """Replace the running backend.

        The instruction is kept unless a new one is given. What can be refused beforehand is refused while the old one
        still works; a warm switch that fails at any time leaves the old one at work.
        """
        old = self.supervisor.require_running("inference")
        if request.instruction is None and old.report is not None and old.report.instruction:
            request = replace(request, instruction=old.report.instruction)
        selection = self._select_inference(request, role)
        self._check_may_move(selection)
        return self._replacing.replace(old, selection, self._inference_trial(selection), mode, on_stage)

    def roll_back_inference(self, mode: SwitchMode, on_stage: Stage) -> Switched:
        """Replace the running backend by the one before the last switch, with the present instruction.

        Raises:
            StateError: there was no switch.
        """
        old = self.supervisor.require_running("inference")
        selection = self._replacing.before("inference", InferenceTrial.noun)
        section = selection.config.inference
        assert section is not None
        instruction = old.report.instruction if old.report is not None else section.instruction
        section = section.model_copy(update={"instruction": instruction})
        selection = replace(selection, config=selection.config.model_copy(update={"inference": section}))
        self._check_may_move(selection)
        return self._replacing.replace(old, selection, self._inference_trial(selection), mode, on_stage)

    def switch_perception(
        self,
        source: str | None,
        cameras: tuple[str, ...],
        options: Options,
        mode: SwitchMode,
        on_stage: Stage,
        role: str = "",
    ) -> Switched:
        """Replace the running source of images, on the same topics; it serves the same cameras unless others are named.

        Raises as `switch_inference`.
        """
        old = self.supervisor.require_running("perception")
        assert old.choice is not None
        running = old.choice.settings.config.perception
        served = running.cameras if running is not None else ()
        selection = select_perception(self.config, self.plugins.current(), source, cameras or served, options, role)
        self._check_serves_backend(selection)
        return self._replacing.replace(old, selection, PerceptionTrial(self.supervisor, selection), mode, on_stage)

    def roll_back_perception(self, mode: SwitchMode, on_stage: Stage) -> Switched:
        """Go back to the source before the last switch. Raises StateError when there was no switch."""
        old = self.supervisor.require_running("perception")
        selection = self._replacing.before("perception", PerceptionTrial.noun)
        self._check_serves_backend(selection)
        return self._replacing.replace(old, selection, PerceptionTrial(self.supervisor, selection), mode, on_stage)

    def switch_control(
        self, controller: str | None, options: Options, mode: SwitchMode, on_stage: Stage, role: str = ""
    ) -> Switched:
        """Replace the running controller, on the same topics. Raises as `switch_inference`."""
        old = self.supervisor.require_running("control")
        selection = select_control(self.config, self.plugins.current(), controller, options, role)
        check_same_commands(old, selection)
        return self._replacing.replace(old, selection, ControlTrial(self.supervisor, selection), mode, on_stage)

    def roll_back_control(self, mode: SwitchMode, on_stage: Stage) -> Switched:
        """Go back to the controller before the last switch. Raises StateError when there was no switch."""
        old = self.supervisor.require_running("control")
        selection = self._replacing.before("control", ControlTrial.noun)
        return self._replacing.replace(old, selection, ControlTrial(self.supervisor, selection), mode, on_stage)

    def _inference_trial(self, selection: Selection) -> InferenceTrial:
        return InferenceTrial(self.supervisor, selection, self.stream(selection.config.namespace))

    def stream(self, namespace: str) -> ActionStream:
        """What is sent on a robot's action topic since a backend was first started for it."""
        with self._lock:
            if namespace not in self._streams:
                self._streams[namespace] = ActionStream(self.supervisor.link, namespace)
            return self._streams[namespace]

    def last_actions(self, most: int) -> list[dict[str, Any]]:
        """The newest actions on the present robot's action topic: source time [ns] and values; for the records."""
        with self._lock:
            stream = self._streams.get(self.config.namespace)
        return [{"sent_ns": at, "values": list(values)} for at, values in stream.newest(most)] if stream else []

    def stop(self, kind: ModuleKind) -> Stopped | None:
        """Stop one module. Raises as `Supervisor.stop`."""
        self.on_stop(kind)
        return self.supervisor.stop(kind)

    def stop_all(self) -> list[Stopped]:
        """Stop everything, in the reverse order of starting."""
        for kind in MODULE_KINDS:
            self.on_stop(kind)
        return self.supervisor.stop_all()

    def cancel(self, kind: ModuleKind) -> None:
        """The client that asked for a start does not want it any more."""
        self.supervisor.cancel(kind, "the client cancelled the call.")

    def set_instruction(self, text: str, timeout_s: float) -> tuple[Report, float]:
        """Hand the backend a new instruction; returns when its first action for it was published, and after how long.

        Raises:
            InvalidInputError: the instruction is empty or refused by the module.
            StateError: no backend is running.
            RefusedError: the emergency stop is latched, so nothing would happen.
            UngroundedError: the backend cannot act on it; nothing moves.
            NotReadyError: no action within the time; the message says what is missing.
        """
        text = check_instruction(text)
        self.supervisor.require_running("inference")
        self._check_not_latched()
        return instruct(self.supervisor, text, timeout_s)

    def _check_may_move(self, selection: Selection) -> None:
        """A backend with an instruction has to prove itself by an action, which a latched stop forbids."""
        section = selection.config.inference
        if section is not None and section.instruction:
            self._check_not_latched()

    def _check_not_latched(self) -> None:
        if self.emergency_stop.is_latched():
            cause = self.emergency_stop.cause()
            raise RefusedError(
                f"The emergency stop is latched{f' ({cause})' if cause else ''}: nothing would move.",
                hint="A person releases it: see reset_emergency_stop.",
            )

    def _select_inference(self, request: InferenceRequest, role: str) -> Selection:
        selection = select_inference(self.config, self.plugins.current(), request, role)
        perception = self.supervisor.view("perception")
        if perception.phase == "running" and perception.choice is not None:
            check_cameras(self.plugins.current(), selection.config, perception.choice.settings.config)
        return selection

    def _check_serves_backend(self, selection: Selection) -> None:
        inference = self.supervisor.view("inference")
        if inference.phase == "running" and inference.choice is not None:
            check_cameras(self.plugins.current(), inference.choice.settings.config, selection.config)

    def _start(self, kind: ModuleKind, selection: Selection, on_stage: Stage) -> ModuleView:
        self.emergency_stop.prepare(selection.config.namespace)
        if kind == "inference":
            self.stream(selection.config.namespace)
        return self.supervisor.start(
            kind, selection.config, python=selection.python, names=selection.names, on_stage=on_stage
        )

    def _base_sections(self) -> dict[str, Any]:
        return {
            "perception": self.base.perception,
            "inference": self.base.inference,
            "control": self.base.control,
        }
