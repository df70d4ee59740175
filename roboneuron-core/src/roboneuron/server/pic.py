"""The closed-loop tools (perception, inference, control): what the agent reads, around `ClosedLoop`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.server.loop import ClosedLoop, Switched
from roboneuron.server.results import (
    InstructionResult,
    StartResult,
    StopAllResult,
    StopResult,
    SwitchResult,
    module_status,
    stop_result,
)
from roboneuron.server.selection import InferenceRequest
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Stage, Tool
from roboneuron.supervisor.view import ModuleView

MAX_INSTRUCTION_LENGTH = 1000
"""The inference module refuses longer ones."""

Options = Annotated[
    dict[str, Any],
    Field(
        default_factory=dict,
        description="Options of the chosen plugin, laid over [plugins.<name>] of the configuration.",
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
    """Arguments of start_inference and switch_inference."""

    backend: str | None = Field(default=None, description="Which policy; the configured one when omitted.")
    checkpoint: str | None = Field(
        default=None, min_length=1, description="Directory of the model's files, for backends that need one."
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
        return InferenceRequest(**{name: getattr(self, name) for name in type(self).model_fields})


class SwitchInference(StartInference):
    """Arguments of switch_inference."""

    mode: Literal["warm", "cold"] = Field(
        default="warm",
        description="warm: the new backend is loaded beside the old one and takes over between two actions; cold: the "
        "old one is stopped first, for a machine without memory for two.",
    )
    rollback: bool = Field(
        default=False, description="Go back to the backend before the last switch; nothing else may be named then."
    )

    @model_validator(mode="after")
    def _check_rollback(self) -> SwitchInference:
        others = sorted(self.model_fields_set - {"mode", "rollback"})
        if self.rollback and others:
            raise ValueError(f"with rollback nothing else may be named, got {', '.join(others)}")
        return self

    def to_request(self) -> InferenceRequest:
        """The same, as `ClosedLoop` takes it."""
        return InferenceRequest(**{name: getattr(self, name) for name in StartInference.model_fields})


class SetInstruction(Arguments):
    """Arguments of set_instruction."""

    instruction: str = Field(
        max_length=MAX_INSTRUCTION_LENGTH, description='What to do, for instance "pick up the red cube".'
    )
    timeout_s: float = Field(
        default=30.0, gt=0, le=600, description="How long to wait for the first action, in seconds."
    )


_PROOF = {
    "robot": "its first joint state was measured",
    "perception": "each camera has delivered its first image",
    "control": "it has received joint states and published the first end-effector pose",
    "inference": "it has received all its inputs and, when it has an instruction, published its first action",
}
_ORDER = "Usual order: start_robot, start_perception, start_control, start_inference."


def closed_loop_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """All tools of the closed loop, in the order in which an agent uses them."""
    return [
        *_start_tools(loop),
        *_steering_tools(loop),
        *(_stop_tool(loop, kind) for kind in MODULE_KINDS),
        _stop_all(loop),
    ]


def _started(view: ModuleView, started_s: float) -> StartResult:
    return StartResult(module=module_status(view), took_s=round(time.monotonic() - started_s, 3))


def switch_result(switched: Switched) -> SwitchResult:
    """How a switch went, as the agent reads it."""
    change, gap = switched.change, switched.change.gap
    return SwitchResult(
        module=module_status(switched.view),
        replaced=switched.replaced,
        mode=switched.mode,
        gap_s=round(gap.gap_s, 4) if gap is not None else None,
        period_s=round(gap.period_s, 4) if gap is not None else None,
        missed_actions=gap.missed if gap is not None else None,
        difference=round(change.difference, 4) if change.difference is not None else None,
        took_s=round(switched.took_s, 3),
    )


def _start_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    plugins = loop.plugins

    def starter(kind: ModuleKind, work: Callable[[Any, Stage], ModuleView]) -> Any:
        async def handler(arguments: Any, context: CallContext) -> StartResult:
            started_s = time.monotonic()
            view = await context.run(lambda stage: work(arguments, stage), on_cancel=lambda: loop.cancel(kind))
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
            handler=starter("robot", lambda a, stage: loop.start_robot(a.robot, a.driver, a.options, stage)),
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
                "perception", lambda a, stage: loop.start_perception(a.source, tuple(a.cameras), a.options, stage)
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
            handler=starter("control", lambda a, stage: loop.start_control(a.controller, a.options, stage)),
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
            handler=starter("inference", lambda a, stage: loop.start_inference(a.to_request(), stage)),
            open_world=True,
            choices=_inference_choices(loop),
        ),
    ]


def _inference_choices(loop: ClosedLoop) -> dict[str, Callable[[], dict[str, str]]]:
    plugins = loop.plugins
    return {
        "backend": lambda: plugins.choices("backend"),
        "runtime": lambda: plugins.choices("runtime"),
        "acceleration": lambda: plugins.choices("acceleration"),
    }


def _steering_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    async def set_instruction(arguments: SetInstruction, context: CallContext) -> InstructionResult:
        report, took_s = await context.run(lambda _: loop.set_instruction(arguments.instruction, arguments.timeout_s))
        return InstructionResult(instruction=report.instruction, took_s=round(took_s, 3), note=report.note)

    async def switch_inference(arguments: SwitchInference, context: CallContext) -> SwitchResult:
        def work(stage: Stage) -> Switched:
            if arguments.rollback:
                return loop.roll_back_inference(arguments.mode, stage)
            return loop.switch_inference(arguments.to_request(), arguments.mode, stage)

        switched = await context.run(work, on_cancel=lambda: loop.cancel("inference"))
        return switch_result(switched)

    return [
        Tool(
            name="set_instruction",
            title="Tell the robot what to do",
            description=(
                "Give the running backend a new instruction, without a restart. Returns when its first action for it "
                "was published: the robot is moving then, not done; watch get_status and get_camera_image. If the "
                "backend cannot act on the instruction, its reason is the error and nothing moves."
            ),
            arguments=SetInstruction,
            result=InstructionResult,
            handler=set_instruction,
            open_world=True,
        ),
        Tool(
            name="switch_inference",
            title="Replace the policy",
            description=(
                "Replace the running backend by another one on the same topics. Warm, the new one is loaded and tried "
                "in shadow while the old one works, then takes over between two actions; if it fails, or wants "
                "something wildly different, the old one goes on and the error says why. Cold, the arm holds meanwhile "
                "and a failure leaves no backend. The instruction is kept unless a new one is given."
            ),
            arguments=SwitchInference,
            result=SwitchResult,
            handler=switch_inference,
            destructive=True,
            open_world=True,
            choices=_inference_choices(loop),
        ),
    ]


def _stop_tool(loop: ClosedLoop, kind: ModuleKind) -> Tool[Any]:
    effect = {
        "robot": "the driver holds the robot and disconnects",
        "perception": "the cameras are closed; actions cease when images do",
        "inference": "no more actions; the arm holds",
        "control": "the arm holds; no more joint commands",
    }[kind]

    async def handler(_: NoArguments, context: CallContext) -> StopResult:
        return stop_result(kind, await context.run(lambda _: loop.stop(kind)))

    return Tool(
        name=f"stop_{kind}",
        title=f"Stop {kind}",
        description=f"Stop {kind}: {effect}. Returns when its process is gone; also cancels a start in progress. "
        "An error if it does not run.",
        arguments=NoArguments,
        result=StopResult,
        handler=handler,
        destructive=True,
        open_world=True,
        always=True,
    )


def _stop_all(loop: ClosedLoop) -> Tool[Any]:
    async def handler(_: NoArguments, context: CallContext) -> StopAllResult:
        stopped = await context.run(lambda _: loop.stop_all())
        return StopAllResult(stopped=[stop_result(s.kind, s) for s in stopped])

    return Tool(
        name="stop_all",
        title="Stop everything",
        description="Stop all modules in the reverse order of their start. Returns when all processes are gone.",
        arguments=NoArguments,
        result=StopAllResult,
        handler=handler,
        destructive=True,
        idempotent=True,
        open_world=True,
        always=True,
    )
