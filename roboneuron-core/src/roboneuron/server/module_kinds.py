"""The table of module kinds: the closed loop and the tools that start and stop modules are made
from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from roboneuron.config import ControlConfig, InferenceConfig, PerceptionConfig, RobotConfig
from roboneuron.modules.settings import MAX_INSTRUCTION_LENGTH, ModuleKind
from roboneuron.server.tool import Arguments, NoArguments

ModuleSection = RobotConfig | PerceptionConfig | ControlConfig | InferenceConfig
Instruction = Annotated[
    str | None,
    Field(
        max_length=MAX_INSTRUCTION_LENGTH,
        description='What to do at once, such as "pick up the red cube"; set_instruction gives '
        "one later.",
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
    section: type[ModuleSection]
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
        start_text="Connect to the robot, or start its simulation. It stands still until "
        "something moves it.",
        proof="its joints are measured",
        stop_text="Let the robot hold its position, and disconnect from it or end its simulation.",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        offer="perception",
        section=PerceptionConfig,
        request=NoArguments,
        title="Start the cameras",
        start_text="Start the cameras. A simulated robot's cameras need start_robot first.",
        proof="each camera has delivered an image",
        stop_text="Close the cameras; a policy without images sends no more actions.",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        offer="controller",
        section=ControlConfig,
        request=NoArguments,
        title="Start the controller",
        start_text="Start the controller, which turns the policy's actions, and move_ee, into "
        "joint commands. Needs "
        "start_robot. The arm stands still until actions come.",
        proof="it measures the pose of the end effector",
        stop_text="Stop the controller; the arm holds its position.",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        offer="backend",
        section=InferenceConfig,
        request=StartInference,
        title="Start the policy",
        start_text="Load a policy (a vision-language-action model or a classical one). With an "
        "instruction the robot "
        "moves at once. Needs start_perception; to move, also start_robot and start_control.",
        proof="the policy receives its inputs and, if it has an instruction, has sent its first "
        "action",
        stop_text="Stop the policy; the arm holds its position.",
    ),
)
KIND_ENTRIES: Mapping[ModuleKind, KindEntry] = {entry.kind: entry for entry in _TABLE}
"""The kinds in the order in which an agent starts them."""
