"""The tools that replace a running module by another one on the same topics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from pydantic import ConfigDict, Field, model_validator

from rn_selection.requests import StartControl, StartInference, StartPerception
from rn_switching.replacing import Switched, Switching
from roboneuron.modules.settings import ModuleKind
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.module_kinds import KINDS, KindEntry
from roboneuron.server.results import ModuleSummary, module_summary
from roboneuron.server.tool import Arguments, CallContext, Stage, Tool

S = TypeVar("S", bound="Switch")


def _refer_to_start(schema: dict[str, Any], model: type[Switch]) -> None:
    """Describe what is as in the start tool by its name: every agent reads the list of tools in full."""
    start = next(base for base in model.__bases__ if issubclass(base, Arguments) and not issubclass(base, Switch))
    tool = start.__name__.replace("Start", "start_").lower()
    for name, entry in schema["properties"].items():
        field = start.model_fields.get(name)
        if field is not None and field.description == entry.get("description"):
            entry["description"] = f"As in {tool}."


class Switch(Arguments):
    """What every switch can be told."""

    model_config = ConfigDict(json_schema_extra=_refer_to_start)

    mode: Literal["warm", "cold"] = Field(
        default="warm",
        description="warm: the new one is tried beside the old one first; cold: the old one is stopped first.",
    )
    rollback: bool = Field(default=False, description="Back to what ran before; then nothing else may be named.")

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


class SwitchResult(ModuleSummary):
    """The new module runs and has proved that it works."""

    replaced: dict[str, str] = Field(description="what ran before")
    mode: Literal["warm", "cold", "in place"] = Field(
        description="how it was done; in place: the running process went on with another acceleration"
    )
    gap_s: float | None = Field(
        default=None,
        description="from the last output of the old one to the first of the new one, by the times at which they were "
        "sent (actions of a backend, commands of a controller, images of a source, of the camera with the longest "
        "gap); none when one of them sent nothing",
    )
    period_s: float | None = Field(default=None, description="time between the old one's outputs")
    missed: int | None = Field(default=None, description="outputs left out in the old one's rhythm")
    difference: float | None = Field(
        default=None, description="how far the new actions, or commands, lay from the old ones in shadow [m or rad]"
    )
    took_s: float = Field(description="the whole call, loading included")


@dataclass(frozen=True, kw_only=True, slots=True)
class _Text:
    """What the agent reads of the switch tool of one kind."""

    arguments: type[Switch]
    title: str
    description: str


_TEXTS: Mapping[ModuleKind, _Text] = {
    "inference": _Text(
        arguments=SwitchInference,
        title="Replace the policy",
        description="Replace the running backend by another one on the same topics. Warm, the new one is loaded and "
        "tried in shadow, then takes over between two actions; if it fails, or wants something wildly different, the "
        "old one goes on. Cold, the arm holds meanwhile and a failure leaves no backend. A change of the acceleration "
        "alone is made in the running process where the runtime can. The instruction is kept unless one is given.",
    ),
    "perception": _Text(
        arguments=SwitchPerception,
        title="Replace the cameras' source",
        description="Replace the running source of images by another one on the same topics. Warm, the new one "
        "delivers unseen first, then takes over between two images; if it fails, or its images have another size, the "
        "old one goes on. Cold, there are no images meanwhile (for a device that only one process can open) and a "
        "failure leaves no source.",
    ),
    "control": _Text(
        arguments=SwitchControl,
        title="Replace the controller",
        description="Replace the running controller by another one on the same topics, also to change its options. "
        "Warm, the new one answers the same actions unseen, then takes over between two commands; if it fails, would "
        "hold, or its commands or TCP pose lie apart, the old one goes on. Cold, the arm holds meanwhile and a "
        "failure leaves no controller.",
    ),
}


def switch_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """One for each kind of module that can be replaced."""
    switching = Switching(loop)
    return [_switch_tool(loop, switching, KINDS[kind], text) for kind, text in _TEXTS.items()]


def _switch_tool(loop: ClosedLoop, switching: Switching, entry: KindEntry, text: _Text) -> Tool[Any]:
    kind = entry.kind

    async def handler(request: Switch, context: CallContext) -> SwitchResult:
        def work(stage: Stage) -> Switched:
            if request.rollback:
                return switching.roll_back(kind, request.mode, stage)
            return switching.switch(kind, request, request.mode, stage, context.role)

        return switch_result(await context.run(work, on_cancel=lambda: loop.cancel(kind)))

    return Tool(
        name=f"switch_{kind}",
        title=text.title,
        description=text.description,
        arguments=text.arguments,
        result=SwitchResult,
        handler=handler,
        destructive=True,
        open_world=True,
    )


def switch_result(switched: Switched) -> SwitchResult:
    """How a switch went, as the agent reads it."""
    change, gap = switched.change, switched.change.gap
    return SwitchResult(
        **module_summary(switched.view),
        replaced=switched.replaced,
        mode=switched.mode,
        gap_s=round(gap.gap_s, 4) if gap is not None else None,
        period_s=round(gap.period_s, 4) if gap is not None else None,
        missed=gap.missed if gap is not None else None,
        difference=round(change.difference, 4) if change.difference is not None else None,
        took_s=round(switched.took_s, 3),
    )
