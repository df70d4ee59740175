"""What a module process is told at its start, and the names under which it reports."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.config import Config

ModuleKind = Literal["robot", "perception", "inference", "control"]
MODULE_CLASSES: dict[ModuleKind, str] = {
    "robot": "roboneuron.modules.robot:RobotModule",
    "perception": "roboneuron.modules.perception:PerceptionModule",
    "inference": "roboneuron.modules.inference:InferenceModule",
    "control": "roboneuron.modules.control:ControlModule",
}
"""What a module process of each kind runs, "module:attribute": imported in that process alone."""
MODULE_KINDS: tuple[ModuleKind, ...] = tuple(MODULE_CLASSES)


class ModuleSettings(BaseModel):
    """One line of JSON on the stdin of a module process.

    Attributes:
        kind: which module to run.
        node_name: name of its ROS node under the robot's namespace; the kind unless several run side by side.
        config: the effective configuration, overrides of the start call included.
        state_directory: where the emergency-stop latch is kept.
        on_join: "module:attribute" of functions that features want called with the module's node (`ModuleHost`).
        shadow: work on live inputs without publishing until the handover, see `Handover`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: ModuleKind
    node_name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    config: Config
    state_directory: str
    shadow: bool = False
    on_join: tuple[str, ...] = ()

    @property
    def status_name(self) -> str:
        """Name of the module's DiagnosticStatus: "<namespace>/<node name>"."""
        return f"{self.config.namespace}/{self.node_name}"


INSTRUCTION_PARAMETER = "instruction"
"""ROS parameter of the inference node that sets the instruction without a restart."""
MAX_INSTRUCTION_LENGTH = 1000
FOREIGN_REQUEST = "foreign_request"
"""Counted in `dropped`, and the newest one in words: a lifecycle or parameter request that is not the server's."""
EMERGENCY_STOP_TOPIC = "emergency_stop"
"""std_msgs/Bool under the robot's namespace, reliable and transient local: True latches, False releases."""
FUTURE_S = 0.1
"""How far the clock of another machine may be ahead of this one."""
SHORTEST_STEP_S, FIRST_STEP_S = 0.02, 0.1
"""Time that control gives the arm for an action: that since the one before, at least the first; the second one for an
action after a pause."""
HOLD_SHARE = 0.75
"""Control holds after this share of `action_timeout_s`, so that the arm stands within all of it."""
HOLD_DURATION_S = 0.05
"""Time that a hold gives the joints to be where they were measured."""
STATUS_PERIOD_S = 0.2
"""Every module reports on /diagnostics at least this often, and at once after a change."""
