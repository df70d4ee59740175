"""Tools that replace a running module by another one on the same topics."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

from pydantic import Field, model_validator

from roboneuron.modules.inference.instruction_text import InstructionText
from roboneuron.modules.settings import ModuleKind
from roboneuron.selection.requests import StartChosenInference, StartControl, StartPerception
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.tool import Arguments, CallContext, Tool
from roboneuron.supervisor.changes import Stage
from roboneuron.switching.replacing import Switched, Switching
from roboneuron.tools.loop.results import ModuleSummary

S = TypeVar("S", bound="Switch")


class Switch(Arguments):
    """Arguments common to all switches."""

    mode: Literal["warm", "cold"] = Field(default="warm", description="As said above.")
    rollback: bool = Field(
        default=False, description="Return to what ran before; allows no other argument."
    )

    @model_validator(mode="after")
    def _check_rollback(self: S) -> S:
        others = sorted(self.model_fields_set - {"mode", "rollback"})
        if self.rollback and others:
            raise ValueError(f"rollback allows no other argument, got {', '.join(others)}")
        return self


class SwitchInference(Switch, StartChosenInference):
    """Arguments of switch_inference."""

    instruction: InstructionText | None = Field(
        default=None,
        description="What to do; the present one when omitted.",
    )


class SwitchPerception(Switch, StartPerception):
    """Arguments of switch_perception."""

    cameras: list[str] = Field(
        default_factory=list,
        description="Cameras of the robot to serve; those served now when omitted.",
    )


class SwitchControl(Switch, StartControl):
    """Arguments of switch_control."""


class SwitchResult(ModuleSummary):
    """The new module is running and has passed its readiness check."""

    replaced: dict[str, str] = Field(description="what ran before")
    mode: Literal["warm", "cold", "in place"] = Field(
        description="how it was done; in place: the running process went on with another "
        "acceleration"
    )
    gap_s: float | None = Field(
        default=None,
        description="from the last output of the old one to the first of the new one, by the "
        "times at which they were "
        "sent (actions of a backend, commands of a controller, images of a source, of the camera "
        "with the longest "
        "gap); none when one of them sent nothing",
    )
    period_s: float | None = Field(default=None, description="time between the old one's outputs")
    missed: int | None = Field(default=None, description="outputs left out in the old one's rhythm")
    difference: float | None = Field(
        default=None,
        description="how far the new actions, or commands, lay from the old ones in shadow [m or "
        "rad]",
    )
    took_s: float = Field(description="the whole call, loading included")


@dataclass(frozen=True, kw_only=True, slots=True)
class _Text:
    """Texts of the switch tool of one kind."""

    arguments: type[Switch]
    title: str
    description: str


_TEXTS: Mapping[ModuleKind, _Text] = {
    "inference": _Text(
        arguments=SwitchInference,
        title="Replace the policy",
        description="Replace the running policy; the rest keeps running, the instruction is kept. "
        "warm: the new policy is tried beside the old one without moving anything, and takes over "
        "between two actions; if it fails, or would move very differently, the old one stays. "
        "cold: the arm holds meanwhile; after a failure no policy runs.",
    ),
    "perception": _Text(
        arguments=SwitchPerception,
        title="Replace the cameras' source",
        description="Replace the running image source; the rest keeps running. warm: the new one "
        "takes over when it delivers images of the same size; otherwise the old one stays. cold "
        "(for a device that only one process can open): there are no images meanwhile.",
    ),
    "control": _Text(
        arguments=SwitchControl,
        title="Replace the controller",
        description="Replace the running controller, or change its options. warm: the new one is "
        "tried beside the old one; if it fails, or its commands differ too much, the old one "
        "stays. cold: the arm holds meanwhile.",
    ),
}


def switch_tools(loop: ClosedLoop) -> list[Tool[Switch]]:
    """Create one tool for each kind of replaceable module."""
    switching = Switching(loop)
    return [_switch_tool(loop, switching, kind, text) for kind, text in _TEXTS.items()]


def _switch_tool(
    loop: ClosedLoop, switching: Switching, kind: ModuleKind, text: _Text
) -> Tool[Switch]:
    async def handler(request: Switch, context: CallContext) -> SwitchResult:
        halt = threading.Event()

        def work(stage: Stage) -> Switched:
            if request.rollback:
                return switching.roll_back(kind, request.mode, stage, halt)
            return switching.switch(kind, request, request.mode, stage, context.role, halt)

        return switch_result(await context.run(work, on_cancel=halt.set))

    return Tool(
        name=f"switch_{kind}",
        title=text.title,
        description=text.description,
        arguments=text.arguments,
        result=SwitchResult,
        handler=handler,
        destructive=True,
        open_world=True,
        seldom=True,
        offered=loop.takes_policies if kind == "inference" else lambda: True,
    )


def switch_result(switched: Switched) -> SwitchResult:
    """Convert the result of a switch for the agent."""
    change, gap = switched.change, switched.change.gap
    return SwitchResult.short_of(
        switched.view,
        replaced=switched.replaced,
        mode=switched.mode,
        gap_s=round(gap.gap_s, 4) if gap is not None else None,
        period_s=round(gap.period_s, 4) if gap is not None else None,
        missed=gap.missed if gap is not None else None,
        difference=round(change.difference, 4) if change.difference is not None else None,
        took_s=round(switched.took_s, 3),
    )
