"""Arguments of the start tools, with which clients choose what a module runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from roboneuron.modules.inference.instruction_text import InstructionText
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import KIND_ENTRIES
from roboneuron.server.tool import Arguments

__all__ = ["StartChosenInference"]
"""Names that other distributions may use."""

Options = Annotated[
    dict[str, object],
    Field(
        default_factory=dict,
        description="Of the plugin.",
    ),
]


class StartRobot(Arguments):
    """Arguments of start_robot."""

    robot: str | None = Field(default=None, description="Which robot; see list_robots.")
    driver: str | None = Field(
        default=None,
        description="Which driver moves it, real or simulated; see list_robots.",
    )
    options: Options


class StartPerception(Arguments):
    """Arguments of start_perception."""

    source: str | None = Field(
        default=None, description="Where images come from; see list_perception_sources."
    )
    cameras: list[str] = Field(
        default_factory=list, description="Cameras of the robot to serve; all of them when omitted."
    )
    options: Options


class StartControl(Arguments):
    """Arguments of start_control."""

    controller: str | None = Field(
        default=None,
        description="What turns actions into joint commands; see list_controllers.",
    )
    options: Options


class StartChosenInference(Arguments):
    """Arguments of start_inference."""

    backend: str | None = Field(default=None, description="Which policy; see list_backends.")
    checkpoint: str | None = Field(
        default=None,
        min_length=1,
        description="Directory of the model's files.",
    )
    runtime: str | None = Field(
        default=None,
        description="Engine that executes the model.",
    )
    acceleration: str | None = Field(default=None, description="Preset; none when omitted.")
    model: str | None = Field(
        default=None, description="A model of the configuration, instead of these four."
    )
    host: str | None = Field(
        default=None,
        description="Machine in the configuration, to run it.",
    )
    instruction: InstructionText | None = Field(
        default=None,
        description="What to do at once.",
    )
    cameras: dict[str, str] | None = Field(
        default=None,
        description="Camera name by role of the backend; the robot's own roles when omitted.",
    )
    options: Options


REQUESTS: Mapping[ModuleKind, type[Arguments]] = {
    "robot": StartRobot,
    "perception": StartPerception,
    "control": StartControl,
    "inference": StartChosenInference,
}
"""Arguments of the start tool by kind of module; the argument for the module's content has the name
of its `noun`.
"""


def choices_of(kind: ModuleKind) -> dict[str, str]:
    """Arguments that name plugins -> kind of these plugins."""
    more = {"runtime": "runtime", "acceleration": "acceleration"} if kind == "inference" else {}
    return {KIND_ENTRIES[kind].noun: KIND_ENTRIES[kind].offer, **more}
