"""The tools that replace a running module by another one on the same topics, around `ClosedLoop`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar

from pydantic import Field, model_validator

from roboneuron.modules.settings import ModuleKind
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.replacing import Switched, SwitchMode
from roboneuron.server.results import SwitchResult, module_status
from roboneuron.server.start_tools import StartControl, StartInference, StartPerception, inference_choices
from roboneuron.server.tool import Arguments, CallContext, Stage, Tool

S = TypeVar("S", bound="Switch")


class Switch(Arguments):
    """What every switch can be told."""

    mode: Literal["warm", "cold"] = Field(
        default="warm",
        description="warm: the new one is started and tried beside the old one and takes over between two outputs; "
        "cold: the old one is stopped first, where there is no room for two.",
    )
    rollback: bool = Field(
        default=False, description="Go back to what ran before the last switch; nothing else may be named then."
    )

    @model_validator(mode="after")
    def _check_rollback(self: S) -> S:
        others = sorted(self.model_fields_set - {"mode", "rollback"})
        if self.rollback and others:
            raise ValueError(f"with rollback nothing else may be named, got {', '.join(others)}")
        return self


class SwitchInference(Switch, StartInference):
    """Arguments of switch_inference."""


class SwitchPerception(Switch, StartPerception):
    """Arguments of switch_perception."""

    cameras: list[str] = Field(
        default_factory=list, description="Cameras of the robot to serve; those served now when omitted."
    )


class SwitchControl(Switch, StartControl):
    """Arguments of switch_control."""


def switch_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """One for each module that can be replaced."""

    def switcher(
        kind: ModuleKind,
        switch: Callable[[Any, SwitchMode, Stage, str], Switched],
        roll_back: Callable[[SwitchMode, Stage], Switched],
    ) -> Any:
        async def handler(arguments: Any, context: CallContext) -> SwitchResult:
            def work(stage: Stage) -> Switched:
                if arguments.rollback:
                    return roll_back(arguments.mode, stage)
                return switch(arguments, arguments.mode, stage, context.role)

            return switch_result(await context.run(work, on_cancel=lambda: loop.cancel(kind)))

        return handler

    plugins = loop.plugins
    return [
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
            handler=switcher(
                "inference",
                lambda a, mode, stage, role: loop.switch_inference(a.to_request(), mode, stage, role),
                loop.roll_back_inference,
            ),
            destructive=True,
            open_world=True,
            choices=inference_choices(loop),
        ),
        Tool(
            name="switch_perception",
            title="Replace the cameras' source",
            description=(
                "Replace the running source of images by another one on the same topics. Warm, the new one is opened "
                "and delivers unseen while the old one works, then takes over between two images of each camera; if it "
                "fails, or its images have another size than the backend knows, the old one goes on and the error says "
                "why. Cold, there are no images meanwhile (a device that only one process can open needs that) and a "
                "failure leaves no source."
            ),
            arguments=SwitchPerception,
            result=SwitchResult,
            handler=switcher(
                "perception",
                lambda a, mode, stage, role: loop.switch_perception(
                    a.source, tuple(a.cameras), a.options, mode, stage, role
                ),
                loop.roll_back_perception,
            ),
            destructive=True,
            open_world=True,
            choices={"source": lambda: plugins.choices("perception")},
        ),
        Tool(
            name="switch_control",
            title="Replace the controller",
            description=(
                "Replace the running controller by another one on the same topics, also to change its options. Warm, "
                "the new one answers the same actions unseen while the old one works, then takes over between two "
                "commands, going on from the last one; if it fails, would hold, or its commands or TCP pose lie apart, "
                "the old one goes on and the error says why. Cold, the arm holds meanwhile and a failure leaves no "
                "controller."
            ),
            arguments=SwitchControl,
            result=SwitchResult,
            handler=switcher(
                "control",
                lambda a, mode, stage, role: loop.switch_control(a.controller, a.options, mode, stage, role),
                loop.roll_back_control,
            ),
            destructive=True,
            open_world=True,
            choices={"controller": lambda: plugins.choices("controller")},
        ),
    ]


def switch_result(switched: Switched) -> SwitchResult:
    """How a switch went, as the agent reads it."""
    change, gap = switched.change, switched.change.gap
    return SwitchResult(
        module=module_status(switched.view),
        replaced=switched.replaced,
        mode=switched.mode,
        gap_s=round(gap.gap_s, 4) if gap is not None else None,
        period_s=round(gap.period_s, 4) if gap is not None else None,
        missed=gap.missed if gap is not None else None,
        difference=round(change.difference, 4) if change.difference is not None else None,
        took_s=round(switched.took_s, 3),
    )
