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
        on_join: "module:attribute" of functions that features want called once ROS is joined.
        shadow: work on live inputs without publishing until the handover, see `roboneuron.modules.handover`.
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


class StatusKey:
    """Keys of the KeyValue pairs in a module's DiagnosticStatus (`hardware_id` holds the process id).

    READY is "true" once the module has proved that it works: robot and perception have published a first state or
    image, control has received a first joint state and published `ee_pose`, inference has received every input it needs
    and, when it has an instruction, published a first action. Until then WAITING_FOR names what is missing.
    WORK_AGE_S is the time since the module's threads last got on (the slowest of them counts), WORK_LIMIT_S what that
    may be.
    ERROR_* describe the newest failure and are empty again once the module works; ERROR_COUNT never goes down.
    """

    STATE = "state"
    READY = "ready"
    WAITING_FOR = "waiting_for"
    ERROR_CODE = "error_code"
    ERROR = "error"
    ERROR_HINT = "error_hint"
    ERROR_COUNT = "error_count"
    UPTIME_S = "uptime_s"
    LOOP_AGE_S = "loop_age_s"
    WORK_AGE_S = "work_age_s"
    WORK_LIMIT_S = "work_limit_s"
    RATE_HZ = "rate_hz"
    LATENCY_MS = "latency_ms"
    LATENCY_P99_MS = "latency_p99_ms"
    AGE_MS = "age_ms"
    DROPPED = "dropped"
    PUBLISHED = "published"
    INSTRUCTION = "instruction"
    INSTRUCTION_COUNT = "instruction_count"
    ACTIONS_FOR_INSTRUCTION = "actions_for_instruction"
    NOTE = "note"
    EMERGENCY_STOP = "emergency_stop"


INSTRUCTION_PARAMETER = "instruction"
"""ROS parameter of the inference node that sets the instruction without a restart."""
FOREIGN_REQUEST = "foreign_request"
"""Counted in `dropped`, and the newest one in words: a lifecycle or parameter request that is not the server's."""
EMERGENCY_STOP_TOPIC = "emergency_stop"
"""std_msgs/Bool under the robot's namespace, reliable and transient local: True latches, False releases."""
STATUS_PERIOD_S = 0.2
"""Every module reports on /diagnostics at least this often, and at once after a change."""
ACT_FROM = "act_from_ns"
"""ROS parameter: what is stamped before this ROS time [ns] is only worked on in shadow. 0: none."""
ACT_UNTIL = "act_until_ns"
"""ROS parameter: what is stamped at or after this ROS time [ns] is left to the successor. 0: none."""
PLAY_UNTIL = "play_until_ns"
"""ROS parameter: a chunk that is being played out ends at this ROS time [ns]. 0: at its own end."""
HANDOVER_PARAMETERS = (ACT_FROM, ACT_UNTIL, PLAY_UNTIL)
NEVER_NS = 2**62
"""As ACT_FROM: in shadow until told otherwise."""
