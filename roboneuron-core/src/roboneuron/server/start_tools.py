"""The tools that start the modules of the closed loop, around `ClosedLoop`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import Field

from roboneuron.modules.settings import ModuleKind
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import StartResult, module_status
from roboneuron.server.selection import InferenceRequest
from roboneuron.server.tool import Arguments, CallContext, Stage, Tool
from roboneuron.supervisor.view import ModuleView

MAX_INSTRUCTION_LENGTH = 1000
"""The inference module refuses longer ones."""

Options = Annotated[
    dict[str, Any],
    Field(
        default_factory=dict,
        description="Options of the chosen plugin, laid over [plugins.<name>] of the configuration. Those that name "
        "hosts, files, devices, commands or environment variables are for the configuration only.",
    ),
]


class StartRobot(Arguments):
    """Arguments of start_robot."""

    robot: str | None = Field(default=None, description="Which robot; the configured one when omitted.")
    driver: str | None = Field(
        default=None, description="How it is moved, see list_robots; the configured driver when omitted."
    )
    options: Options


class StartPerception(Arguments):
    """Arguments of start_perception."""

    source: str | None = Field(default=None, description="Where images come from; the configured one when omitted.")
    cameras: list[str] = Field(
        default_factory=list, description="Cameras of the robot to serve; all of them when omitted."
    )
    options: Options


class StartControl(Arguments):
    """Arguments of start_control."""

    controller: str | None = Field(
        default=None, description="What turns actions into joint commands; the configured one when omitted."
    )
    options: Options


class StartInference(Arguments):
    """Arguments of start_inference."""

    backend: str | None = Field(default=None, description="Which policy; the configured one when omitted.")
    checkpoint: str | None = Field(
        default=None,
        min_length=1,
        description="Directory of the model's files, for backends that need one; one that the configuration names or "
        "that lies in its checkpoint_roots.",
    )
    runtime: str | None = Field(
        default=None, description="Engine that executes the model; the backend's own default when omitted."
    )
    acceleration: str | None = Field(default=None, description="Acceleration preset; none when omitted.")
    instruction: str | None = Field(
        default=None,
        max_length=MAX_INSTRUCTION_LENGTH,
        description='What to do, for instance "pick up the red cube"; can be given later with set_instruction.',
    )
    cameras: dict[str, str] | None = Field(
        default=None, description="Camera name by role of the backend; the robot's own roles when omitted."
    )
    options: Options

    def to_request(self) -> InferenceRequest:
        """The same, as `ClosedLoop` takes it."""
        return InferenceRequest(**{name: getattr(self, name) for name in StartInference.model_fields})


_PROOF = {
    "robot": "its first joint state was measured",
    "perception": "each camera has delivered its first image",
    "control": "it has received joint states and published the first end-effector pose",
    "inference": "it has received all its inputs and, when it has an instruction, published its first action",
}
_ORDER = "Usual order: start_robot, start_perception, start_control, start_inference."


def _started(view: ModuleView, started_s: float) -> StartResult:
    return StartResult(module=module_status(view), took_s=round(time.monotonic() - started_s, 3))


def start_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """One for each module, in their usual order."""
    plugins = loop.plugins

    def starter(kind: ModuleKind, work: Callable[[Any, Stage, str], ModuleView]) -> Any:
        async def handler(arguments: Any, context: CallContext) -> StartResult:
            started_s = time.monotonic()
            view = await context.run(
                lambda stage: work(arguments, stage, context.role), on_cancel=lambda: loop.cancel(kind)
            )
            return _started(view, started_s)

        return handler

    def describe(kind: ModuleKind, what: str) -> str:
        return (
            f"{what} Returns when it works ({_PROOF[kind]}); on any failure nothing is left running. "
            f"An error if it already runs. {_ORDER}"
        )

    return [
        Tool(
            name="start_robot",
            title="Start the robot",
            description=describe("robot", "Connect to the robot, or start its simulation; it holds where it is."),
            arguments=StartRobot,
            result=StartResult,
            handler=starter(
                "robot", lambda a, stage, role: loop.start_robot(a.robot, a.driver, a.options, stage, role)
            ),
            open_world=True,
            choices={"robot": lambda: plugins.choices("robot")},
        ),
        Tool(
            name="start_perception",
            title="Start the cameras",
            description=describe("perception", "Open the cameras and publish their images."),
            arguments=StartPerception,
            result=StartResult,
            handler=starter(
                "perception",
                lambda a, stage, role: loop.start_perception(a.source, tuple(a.cameras), a.options, stage, role),
            ),
            open_world=True,
            choices={"source": lambda: plugins.choices("perception")},
        ),
        Tool(
            name="start_control",
            title="Start the controller",
            description=describe(
                "control", "Start turning actions into joint commands; the arm holds until actions come."
            ),
            arguments=StartControl,
            result=StartResult,
            handler=starter("control", lambda a, stage, role: loop.start_control(a.controller, a.options, stage, role)),
            open_world=True,
            choices={"controller": lambda: plugins.choices("controller")},
        ),
        Tool(
            name="start_inference",
            title="Start the policy",
            description=describe(
                "inference",
                "Load a backend (a vision-language-action model or a classical policy). With an instruction, and with "
                "robot and control running, the robot moves.",
            ),
            arguments=StartInference,
            result=StartResult,
            handler=starter("inference", lambda a, stage, role: loop.start_inference(a.to_request(), stage, role)),
            open_world=True,
            choices=inference_choices(loop),
        ),
    ]


def inference_choices(loop: ClosedLoop) -> dict[str, Callable[[], dict[str, str]]]:
    """What a backend, its runtime and its acceleration can be."""
    plugins = loop.plugins
    return {
        "backend": lambda: plugins.choices("backend"),
        "runtime": lambda: plugins.choices("runtime"),
        "acceleration": lambda: plugins.choices("acceleration"),
    }
