"""The table of module kinds: the closed loop and the tools that start and stop modules are made from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from roboneuron.config import Config
from roboneuron.modules.settings import ModuleKind
from roboneuron.plugins.registry import Registry
from roboneuron.server.requests import StartControl, StartInference, StartPerception, StartRobot
from roboneuron.server.selection import (
    Selection,
    select_control,
    select_inference,
    select_perception,
    select_robot,
)
from roboneuron.server.tool import Arguments

Select = Callable[[Config, Registry, Any, str], Selection]
"""Called with the configuration, the installed plugins, a request of the kind's model, and the client's role."""


@dataclass(frozen=True, kw_only=True, slots=True)
class KindEntry:
    """One kind of module. Its section of roboneuron.toml is called as the kind is.

    Attributes:
        kind: which one; its node class is in `roboneuron.modules.settings.MODULE_CLASSES`.
        noun: what such a module runs, for messages.
        request: arguments of its start tool.
        select: turns a request into what is started, or refuses it.
        choices: arguments that name plugins -> kind of these plugins.
        title, start_text: of its start tool.
        proof: what shows that a start has succeeded.
        stop_text: effect of its stop tool.
    """

    kind: ModuleKind
    noun: str
    request: type[Arguments]
    select: Select
    choices: Mapping[str, str]
    title: str
    start_text: str
    proof: str
    stop_text: str


_TABLE = (
    KindEntry(
        kind="robot",
        noun="robot",
        request=StartRobot,
        select=select_robot,
        choices={"robot": "robot"},
        title="Start the robot",
        start_text="Connect to the robot, or start its simulation; it holds where it is.",
        proof="its first joint state was measured",
        stop_text="the driver holds the robot and disconnects",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        request=StartPerception,
        select=select_perception,
        choices={"source": "perception"},
        title="Start the cameras",
        start_text="Open the cameras and publish their images.",
        proof="each camera has delivered its first image",
        stop_text="the cameras are closed; actions cease when images do",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        request=StartControl,
        select=select_control,
        choices={"controller": "controller"},
        title="Start the controller",
        start_text="Start turning actions into joint commands; the arm holds until actions come.",
        proof="it has received joint states and published the first end-effector pose",
        stop_text="the arm holds; no more joint commands",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        request=StartInference,
        select=select_inference,
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
