"""The table of module kinds: the closed loop and the tools that start and stop modules are made from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from roboneuron.config import ControlConfig, InferenceConfig, PerceptionConfig, RobotConfig
from roboneuron.modules.settings import MAX_INSTRUCTION_LENGTH, ModuleKind
from roboneuron.server.tool import Arguments

Section = RobotConfig | PerceptionConfig | ControlConfig | InferenceConfig

Options = Annotated[
    dict[str, Any],
    Field(
        default_factory=dict,
        description="Over [plugins.<name>] of the configuration; hosts, files, devices and commands stand only there.",
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
    model: str | None = Field(default=None, description="Instead of these four: one of list_models.")
    instruction: str | None = Field(
        default=None,
        max_length=MAX_INSTRUCTION_LENGTH,
        description='What to do, for instance "pick up the red cube"; can be given later with set_instruction.',
    )
    cameras: dict[str, str] | None = Field(
        default=None, description="Camera name by role of the backend; the robot's own roles when omitted."
    )
    options: Options


@dataclass(frozen=True, kw_only=True, slots=True)
class KindEntry:
    """One kind of module. Its section of roboneuron.toml is called as the kind is.

    Attributes:
        kind: which one; its node class is in `roboneuron.modules.settings.MODULE_CLASSES`.
        noun: what such a module runs; the argument of its start tool that names it is called so.
        section: model of its section.
        request: arguments of its start tool.
        choices: arguments that name plugins -> kind of these plugins.
        title, start_text: of its start tool.
        proof: what shows that a start has succeeded.
        stop_text: effect of its stop tool.
    """

    kind: ModuleKind
    noun: str
    section: type[Section]
    request: type[Arguments]
    choices: Mapping[str, str]
    title: str
    start_text: str
    proof: str
    stop_text: str


_TABLE = (
    KindEntry(
        kind="robot",
        noun="robot",
        section=RobotConfig,
        request=StartRobot,
        choices={"robot": "robot"},
        title="Start the robot",
        start_text="Connect to the robot, or start its simulation; it holds where it is.",
        proof="its first joint state was measured",
        stop_text="the driver holds the robot and disconnects",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        section=PerceptionConfig,
        request=StartPerception,
        choices={"source": "perception"},
        title="Start the cameras",
        start_text="Open the cameras and publish their images.",
        proof="each camera has delivered its first image",
        stop_text="the cameras are closed; actions cease when images do",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        section=ControlConfig,
        request=StartControl,
        choices={"controller": "controller"},
        title="Start the controller",
        start_text="Start turning actions into joint commands; the arm holds until actions come.",
        proof="it has received joint states and published the first end-effector pose",
        stop_text="the arm holds; no more joint commands",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        section=InferenceConfig,
        request=StartInference,
        choices={"backend": "backend", "runtime": "runtime", "acceleration": "acceleration"},
        title="Start the policy",
        start_text="Load a backend (a vision-language-action model or a classical policy). With an instruction, and "
        "with robot and control running, the robot moves.",
        proof="it has received all its inputs and, when it has an instruction, published its first action",
        stop_text="no more actions; the arm holds",
    ),
)
KINDS: Mapping[ModuleKind, KindEntry] = {entry.kind: entry for entry in _TABLE}
"""The kinds in the order in which an agent starts them."""
