"""The closed loop as the agent operates it: choose, start, steer, switch, stop. Calls block; any thread may call."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

from roboneuron.config import Config
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.modules.settings import INSTRUCTION_PARAMETER, ModuleKind
from roboneuron.server.emergency import EmergencyStop
from roboneuron.server.plugins import PluginCatalogue
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
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.supervisor import Stage, Supervisor
from roboneuron.supervisor.view import ModuleView, Stopped

if TYPE_CHECKING:
    from roboneuron.plugins.specs import RobotSpec

log = logging.getLogger(__name__)
_PARAMETER_S = 5.0


class ClosedLoop:
    """One robot and the modules around it."""

    def __init__(self, config: Config, plugins: PluginCatalogue, supervisor: Supervisor) -> None:
        self.base = config
        self.plugins = plugins
        self.supervisor = supervisor
        self.emergency_stop = EmergencyStop(supervisor)

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

    def start_robot(self, robot: str | None, driver: str | None, options: Options, on_stage: Stage) -> ModuleView:
        """Start a robot. Raises as `select_robot` and `Supervisor.start`."""
        selection = select_robot(self.base, self.plugins.current(), robot, driver, options)
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
        self, source: str | None, cameras: tuple[str, ...], options: Options, on_stage: Stage
    ) -> ModuleView:
        """Start the cameras. Raises as `select_perception` and `Supervisor.start`."""
        return self._start(
            "perception", select_perception(self.config, self.plugins.current(), source, cameras, options), on_stage
        )

    def start_control(self, controller: str | None, options: Options, on_stage: Stage) -> ModuleView:
        """Start the controller. Raises as `select_control` and `Supervisor.start`."""
        return self._start(
            "control", select_control(self.config, self.plugins.current(), controller, options), on_stage
        )

    def start_inference(self, request: InferenceRequest, on_stage: Stage) -> ModuleView:
        """Start a backend. Raises as `select_inference` and `Supervisor.start`."""
        selection = self._select_inference(request)
        self._check_may_move(selection)
        return self._start("inference", selection, on_stage)

    def switch_inference(self, request: InferenceRequest, on_stage: Stage) -> tuple[ModuleView, dict[str, str], float]:
        """Replace the running backend; returns the new one, what ran before, and the gap in seconds.

        The instruction is kept unless a new one is given. What can be refused beforehand is refused while the old one
        still works.
        """
        old = self.supervisor.require_running("inference")
        if request.instruction is None and old.report is not None and old.report.instruction:
            request = InferenceRequest(
                backend=request.backend,
                checkpoint=request.checkpoint,
                runtime=request.runtime,
                acceleration=request.acceleration,
                instruction=old.report.instruction,
                cameras=request.cameras,
                options=request.options,
            )
        selection = self._select_inference(request)
        self._check_may_move(selection)
        replaced = dict(old.choice.names) if old.choice is not None else {}
        on_stage("inference: stopping the old backend")
        started_s = time.monotonic()
        self.supervisor.stop("inference")
        try:
            view = self._start("inference", selection, on_stage)
        except RoboNeuronError as error:
            before = ", ".join(f"{key} {name!r}" for key, name in replaced.items())
            error.hint = f"{error.hint} No backend is running now; before there was {before}.".strip()
            raise
        return view, replaced, time.monotonic() - started_s

    def stop(self, kind: ModuleKind) -> Stopped | None:
        """Stop one module. Raises as `Supervisor.stop`."""
        return self.supervisor.stop(kind)

    def stop_all(self) -> list[Stopped]:
        """Stop everything, in the reverse order of starting."""
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
        view = self.supervisor.require_running("inference")
        self._check_not_latched()
        before = view.report
        count = before.instruction_count if before is not None else 0
        errors = before.error_count if before is not None else 0
        started_s = time.monotonic()
        self._set_parameter(view, text)

        def settled() -> Report | None:
            report = self.supervisor.require_running("inference").report
            if report is None or report.instruction_count <= count:
                return None
            if report.actions_for_instruction > 0:
                return report
            failure = report.failure()
            if failure is not None and report.error_count > errors:
                raise failure
            return None

        report = self.supervisor.changes.wait_for(settled, timeout_s)
        if report is None:
            newest = self.supervisor.view("inference").report
            missing = newest.waiting_for or newest.note if newest is not None else "its status"
            raise NotReadyError(
                f"The backend has published no action for {text!r} within {timeout_s:g} s; it waits for: "
                f"{missing or 'its first inference'}.",
                hint="The instruction stays set; see get_status, or give another one.",
            )
        return report, time.monotonic() - started_s

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
                hint="Call reset_emergency_stop when a person says so.",
            )

    def _select_inference(self, request: InferenceRequest) -> Selection:
        config = self.config
        selection = select_inference(config, self.plugins.current(), request)
        perception = self.supervisor.view("perception")
        if perception.phase == "running" and perception.choice is not None:
            section = perception.choice.settings.config.perception
            served = section.cameras if section is not None else ()
            backend = self.plugins.current().get("backend", selection.names["backend"])
            needed = [selection.cameras[role] for role in backend.cameras]
            absent = [camera for camera in needed if served and camera not in served]
            if absent:
                raise InvalidInputError(
                    f"Backend {backend.name!r} needs the camera {', '.join(absent)}, "
                    f"but perception serves only {', '.join(served)}.",
                    hint="Stop perception and start it with all cameras, or name others in `cameras`.",
                )
        return selection

    def _start(self, kind: ModuleKind, selection: Selection, on_stage: Stage) -> ModuleView:
        self.emergency_stop.prepare(selection.config.namespace)
        return self.supervisor.start(
            kind, selection.config, python=selection.python, names=selection.names, on_stage=on_stage
        )

    def _base_sections(self) -> dict[str, Any]:
        return {
            "perception": self.base.perception,
            "inference": self.base.inference,
            "control": self.base.control,
        }

    def _set_parameter(self, view: ModuleView, text: str) -> None:
        from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # heavy
        from rcl_interfaces.srv import SetParameters  # heavy

        assert view.choice is not None
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
        request = SetParameters.Request(parameters=[Parameter(name=INSTRUCTION_PARAMETER, value=value)])
        name = f"/{view.choice.settings.status_name}/set_parameters"
        link, changes = self.supervisor.link, self.supervisor.changes
        if not changes.wait_for(lambda: link.is_service_ready(SetParameters, name), _PARAMETER_S):
            raise NotReadyError(f"The service {name} was not found within {_PARAMETER_S:g} s.")
        call = link.call(SetParameters, name, request, changes.notify)
        if not changes.wait_for(lambda: call.done, _PARAMETER_S):
            call.abandon()
            raise NotReadyError(
                f"The inference module did not take the instruction within {_PARAMETER_S:g} s.",
                hint="It may hang: see loop_age_s in get_status.",
            )
        result = call.response.results[0]
        if not result.successful:
            raise InvalidInputError(f"The backend refused the instruction: {result.reason}.", path="instruction")
