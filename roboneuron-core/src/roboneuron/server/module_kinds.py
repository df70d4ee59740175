"""The table of module kinds: the closed loop and the tools that start and stop modules are made from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from roboneuron.config import ControlConfig, InferenceConfig, PerceptionConfig, RobotConfig
from roboneuron.modules.settings import MAX_INSTRUCTION_LENGTH, ModuleKind
from roboneuron.server.tool import Arguments, NoArguments

Section = RobotConfig | PerceptionConfig | ControlConfig | InferenceConfig
Instruction = Annotated[
    str | None,
    Field(
        max_length=MAX_INSTRUCTION_LENGTH,
        description='What to do, for instance "pick up the red cube"; can be given later with set_instruction.',
    ),
]


class StartInference(Arguments):
    """Arguments of start_inference."""

    instruction: Instruction = None


@dataclass(frozen=True, kw_only=True, slots=True)
class KindEntry:
    """One kind of module. Its section of roboneuron.toml is called as the kind is.

    Attributes:
        kind: which one; its node class is in `roboneuron.modules.settings.MODULE_CLASSES`.
        noun: what such a module runs.
        offer: kind of the plugins that offer it.
        section: model of its section.
        request: arguments of its start tool.
        title, start_text: of its start tool.
        proof: what shows that a start has succeeded.
        stop_text: effect of its stop tool.
    """

    kind: ModuleKind
    noun: str
    offer: str
    section: type[Section]
    request: type[Arguments]
    title: str
    start_text: str
    proof: str
    stop_text: str


_TABLE = (
    KindEntry(
        kind="robot",
        noun="robot",
        offer="robot",
        section=RobotConfig,
        request=NoArguments,
        title="Start the robot",
        start_text="Connect to the robot, or start its simulation; it holds where it is.",
        proof="its first joint state was measured",
        stop_text="the driver holds the robot and disconnects",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        offer="perception",
        section=PerceptionConfig,
        request=NoArguments,
        title="Start the cameras",
        start_text="Open the cameras and publish their images.",
        proof="each camera has delivered its first image",
        stop_text="the cameras are closed; actions cease when images do",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        offer="controller",
        section=ControlConfig,
        request=NoArguments,
        title="Start the controller",
        start_text="Start turning actions into joint commands; the arm holds until actions come.",
        proof="it has received joint states and published the first end-effector pose",
        stop_text="the arm holds; no more joint commands",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        offer="backend",
        section=InferenceConfig,
        request=StartInference,
        title="Start the policy",
        start_text="Load a backend (a vision-language-action model or a classical policy). With an instruction, and "
        "with robot and control running, the robot moves.",
        proof="it has received all its inputs and, when it has an instruction, published its first action",
        stop_text="no more actions; the arm holds",
    ),
)
KINDS: Mapping[ModuleKind, KindEntry] = {entry.kind: entry for entry in _TABLE}
"""The kinds in the order in which an agent starts them."""
