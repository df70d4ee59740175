"""Frozen models of roboneuron.toml: core's sections, and the whole file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from roboneuron.config.arms import ArmConfig
from roboneuron.config.cameras import CameraConfig
from roboneuron.config.section import CameraName as CameraName
from roboneuron.config.section import Name as Name
from roboneuron.config.section import Namespace as Namespace
from roboneuron.config.section import Point as Point
from roboneuron.config.section import Seconds as Seconds
from roboneuron.config.section import Section as Section
from roboneuron.config.section import Share as Share

Reaction = Literal["hold", "scale", "refuse"]
"""Reaction to a limit: hold at the measured posture, shorten the command, or send nothing and let
the last command end.
"""
ModuleKind = str
"""Kind of a module: robot, perception, inference or control, or one that a feature adds
(`FeatureSpec.module_kind`).
"""
FIRST_STEP_S = 0.1
"""Time that control allows the arm for the first action after a pause [s]."""


class ModuleSection(Section):
    """Section of one kind of module."""

    start_timeout_s: Seconds | None = Field(
        default=None,
        description="longest start, loading included; as in [supervisor] when not given",
    )
    python: str | None = Field(
        default=None, description="interpreter of the module's own environment"
    )


class RobotConfig(ModuleSection):
    """`[robot]`: the robot and its driver."""

    name: Name = Field(description="a robot of an installed plugin, or a name for [robot.arm]")
    driver: Name = Field(default="simulated", description="one of the robot's drivers")
    namespace: Namespace | None = Field(
        default=None, description="ROS namespace; the robot's name when not given"
    )
    command_timeout_s: Seconds = Field(
        default=1.0, description="the driver holds when commands cease for this long"
    )
    server_timeout_s: Seconds = Field(
        default=2.0, description="the driver holds when the server is frozen this long"
    )
    state_rate_hz: Annotated[float, Field(ge=10, le=1000)] = Field(
        default=120.0, description="rate of joint_states"
    )
    cameras: dict[CameraName, CameraConfig] = Field(
        default_factory=dict,
        description="measured calibration of a camera, by `roboneuron robot cameras calibrate`",
    )
    arm: ArmConfig | None = Field(default=None, description="an arm that no plugin offers")


class PerceptionConfig(ModuleSection):
    """`[perception]`: source of the images."""

    source: Name = Field(description="a perception source offered by an installed plugin")
    cameras: tuple[CameraName, ...] = Field(
        default=(),
        strict=False,
        description="names of the robot's cameras to serve; all of them when empty",
    )


class InferenceConfig(ModuleSection):
    """`[inference]`: the policy and its execution."""

    backend: Name = Field(description="a backend offered by an installed plugin")
    checkpoint: str | None = Field(default=None, description="directory of the model's files")
    runtime: Name | None = Field(
        default=None, description="runtime; the backend's own default when not given"
    )
    acceleration: Name | None = Field(
        default=None, description="acceleration preset; none when not given"
    )
    fallback: Name | None = Field(
        default=None,
        description="a backend that acts while the other one does not answer in time; without one "
        "the arm holds",
    )
    instruction: str = Field(default="", description="what to do; can be set later")
    cameras: dict[str, CameraName] = Field(
        default_factory=dict, description="camera name by role of the backend"
    )
    max_image_age_s: Seconds = Field(
        default=0.5, description="older images, joint states and poses are never acted on"
    )
    max_tail_age_s: Seconds | None = Field(
        default=None,
        description="likewise for later rows of a chunk; when not given max_image_age_s and the "
        "length of the chunk",
    )
    execution: Literal["auto", "sequential", "overlap", "rtc", "predicted-state"] = Field(
        default="auto", description="how chunks are executed; auto chooses by the measured latency"
    )
    switch_max_difference: Annotated[float, Field(gt=0)] = Field(
        default=0.25, description="a warm switch to actions that differ more [m or rad] is refused"
    )
    start_timeout_s: Seconds | None = Field(
        default=None,
        description="longest start, loading included; when not given 900 with a checkpoint, else "
        "as in [supervisor]",
    )


class ControlConfig(ModuleSection):
    """`[control]`: conversion of actions to joint commands."""

    controller: Name = Field(description="a controller offered by an installed plugin")
    action_timeout_s: Seconds = Field(
        default=0.5, description="older actions are dropped; then the arm holds"
    )
    state_timeout_s: Seconds = Field(default=0.25, description="older joint states stop the arm")
    server_timeout_s: Seconds = Field(
        default=2.0, description="the arm holds when the server is frozen this long"
    )
    command: Literal["joint_trajectory", "joint_state"] = Field(
        default="joint_trajectory", description="message type of the command topic"
    )
    horizon_s: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0,
        description="rows of a chunk within this time after the one that is due are limited and "
        "sent with it, for drivers that take them; 0: none",
    )
    switch_max_difference: Annotated[float, Field(gt=0)] = Field(
        default=0.05,
        description="a warm switch to commands or TCP poses that differ more [rad or m] is refused",
    )

    @model_validator(mode="after")
    def _check_horizon(self) -> Self:
        """Check that commands sent ahead end before control holds for lack of actions."""
        if self.horizon_s > self.hold_after_s:
            raise ValueError(
                f"horizon_s is {self.horizon_s:g}, at most {self.hold_after_s:g} (3/4 of "
                "action_timeout_s) are allowed"
            )
        if self.horizon_s and self.command == "joint_state":
            raise ValueError(
                "horizon_s needs command = 'joint_trajectory'; a joint_state carries no times"
            )
        return self

    @property
    def hold_after_s(self) -> float:
        """Time after the last action at which control holds [s], early enough for the arm to stand
        still within `action_timeout_s`.
        """
        return 0.75 * self.action_timeout_s

    def step_s(self, since_s: float) -> float:
        """Time that control allows the arm for an action [s].

        Args:
            since_s: time since the previous action [s]; ignored after a pause.
        """
        return max(since_s, 0.02) if since_s < self.action_timeout_s else FIRST_STEP_S


class SupervisorConfig(Section):
    """`[supervisor]`: bounds on starting and stopping processes."""

    start_timeout_s: Seconds = Field(
        default=60.0, description="spawn until proof of readiness (loading included)"
    )
    stop_timeout_s: Seconds = Field(
        default=5.0, description="deactivate and SIGTERM before SIGKILL"
    )
    hang_timeout_s: Annotated[float, Field(ge=1, le=600)] = Field(
        default=15.0,
        description="a process whose interpreter runs no thread for this long is ended; up to "
        "four times as long while the process gets little of a processor",
    )
    state_directory: str | None = Field(
        default=None, description="logs, latch and audit; XDG state when not given"
    )


class ZoneConfig(Section):
    """One entry of `limits.zones` or `limits.obstacles`."""

    name: str = Field(min_length=1, max_length=64, description="named in reports")
    lower_m: Point = Field(description="corner [x, y, z] in the base frame")
    upper_m: Point = Field(description="opposite corner")


class KeptOutConfig(ZoneConfig):
    """One entry of `limits.zones`."""

    applies_to: Literal["tcp", "arm"] = Field(
        default="tcp", description="tcp; or arm: every link, and what is held, stays out"
    )


class LimitsConfig(Section):
    """`[limits]`: bounds on commands to the arm, by actions or joint commands; see
    docs/safety.md.
    """

    velocity_fraction: Share = Field(
        default=1.0, description="share of the joints' velocity limits in use"
    )
    acceleration_fraction: Share = Field(
        default=1.0, description="share of their acceleration limits in use"
    )
    max_step_m: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="farthest the TCP may go per action"
    )
    max_step_rad: Annotated[float, Field(gt=0, le=3)] = Field(
        default=0.5, description="farthest it may turn per action"
    )
    max_speed_m_s: Annotated[float, Field(gt=0, le=3)] = Field(
        default=0.5, description="fastest motion of the TCP"
    )
    max_turn_rad_s: Annotated[float, Field(gt=0, le=10)] = Field(
        default=2.5, description="fastest turn of the TCP"
    )
    workspace_lower_m: Point | None = Field(
        default=None,
        description="corner of the TCP's box in the base frame; the robot's own when not given",
    )
    workspace_upper_m: Point | None = Field(default=None, description="opposite corner")
    min_height_m: Annotated[float, Field(ge=-100, le=100)] | None = Field(
        default=None, description="lowest z of the TCP in the base frame"
    )
    applies_to: Literal["tcp", "arm"] = Field(
        default="tcp",
        description="what stays in the workspace and above min_height_m: tcp; or arm: every moving "
        "link, and what is held",
    )
    zones: tuple[KeptOutConfig, ...] = Field(
        default=(),
        strict=False,
        description="boxes to stay out of: tables of `name`, `lower_m`, `upper_m`, `applies_to`",
    )
    min_singular_value: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.02,
        description="distance from a singularity: smallest singular value of the TCP's Jacobian",
    )
    collision: bool = Field(
        default=True, description="keep links away from each other and from obstacles"
    )
    min_distance_m: Annotated[float, Field(ge=0, le=0.2)] | None = Field(
        default=None,
        description="least distance between links, and to obstacles; the robot's own when not "
        "given",
    )
    obstacles: tuple[ZoneConfig, ...] | None = Field(
        default=None,
        strict=False,
        description="boxes that no link may touch, as `zones`; the robot's own (its table) when "
        "not given",
    )
    on_position: Reaction = Field(default="hold", description="a joint's position limit")
    on_velocity: Reaction = Field(default="scale", description="a joint's velocity limit")
    on_acceleration: Reaction = Field(default="scale", description="a joint's acceleration limit")
    on_step: Reaction = Field(default="hold", description="max_step_m, max_step_rad")
    on_speed: Reaction = Field(default="scale", description="max_speed_m_s, max_turn_rad_s")
    on_workspace: Reaction = Field(default="hold", description="the workspace box")
    on_zone: Reaction = Field(default="hold", description="zones")
    on_height: Reaction = Field(default="hold", description="min_height_m")
    on_singularity: Reaction = Field(default="hold", description="min_singular_value")
    on_collision: Reaction = Field(
        default="hold", description="min_distance_m between links, and to obstacles"
    )


class ServerConfig(Section):
    """`[server]`: connection of agents."""

    name: str = Field(default="roboneuron", description="server name that MCP clients see")
    transport: Name = Field(
        default="stdio", description="`stdio`, `http` (at /mcp), or what another feature serves"
    )
    max_concurrent_calls: Annotated[int, Field(ge=1, le=10000)] = Field(
        default=64, description="most tool calls at once of each role; stops are always taken"
    )
    reset_emergency_stop: Literal["person", "client"] = Field(
        default="person",
        description="who releases the emergency stop: a person, in a terminal or asked by a "
        "client; or any admin",
    )


class RosConfig(Section):
    """`[ros]`: choice of the ROS 2 installation; `roboneuron doctor` shows it, with the reason."""

    installation: Literal["auto", "wheels", "sourced"] = Field(
        default="auto",
        description="wheels: of this Python environment; sourced: whose setup.bash is sourced, "
        "with its workspaces; auto: sourced where one for this Python is there",
    )


class Config(Section):
    """A whole roboneuron.toml."""

    robot: RobotConfig
    perception: PerceptionConfig | None = None
    inference: InferenceConfig | None = None
    control: ControlConfig | None = None
    limits: LimitsConfig = LimitsConfig()
    supervisor: SupervisorConfig = SupervisorConfig()
    server: ServerConfig = ServerConfig()
    ros: RosConfig = RosConfig()
    disabled_plugins: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="plugins not to load, by name; a distribution means all in it",
    )
    features: tuple[str, ...] = Field(
        default=(), strict=False, description="features without which the server does not start"
    )
    plugins: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="options by plugin name"
    )
    sections: dict[str, Any] = Field(default_factory=dict, exclude=True)
    """Sections of features by top-level key, as in the file; not passed to modules."""
    modules: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Those of the kinds of modules that features add, by kind; passed to modules."""
    robots: dict[str, Config] = Field(default_factory=dict, exclude=True)
    """Complete configuration of each robot by name, for a file with `[robots.<name>]`; the other
    fields are shared.
    """

    @property
    def namespace(self) -> str:
        """ROS namespace of the robot, without a leading slash."""
        return self.robot.namespace or self.robot.name.replace("-", "_")

    @property
    def silence_s(self) -> float:
        """Silence of the server after which modules stop [s]: the shorter `server_timeout_s` of
        robot and control.
        """
        timeouts_s = [self.robot.server_timeout_s]
        if self.control is not None:
            timeouts_s.append(self.control.server_timeout_s)
        return min(timeouts_s)

    @property
    def module_kinds(self) -> tuple[ModuleKind, ...]:
        """Kinds of modules that have a section."""
        known = ("robot", "perception", "inference", "control")
        return (*(kind for kind in known if getattr(self, kind) is not None), *self.modules)

    def module_section(self, kind: str) -> ModuleSection | None:
        """The section of a kind of modules, or None if the file has none. Of a kind that a feature
        adds it has what all kinds have; the feature's own model has the rest.
        """
        if kind not in self.modules:
            known: ModuleSection | None = getattr(self, kind, None)
            return known
        common = ModuleSection.model_fields.keys() & self.modules[kind].keys()
        return ModuleSection(**{key: self.modules[kind][key] for key in common})

    def options(self, name: str) -> Mapping[str, object]:
        """Options of the backend, source, controller, driver ... called `name`; empty if the user
        set none.
        """
        return self.plugins.get(name, {})

    def start_timeout_s(self, kind: str) -> float:
        """Longest start of a module [s]: its own section's, or the supervisor's.

        Args:
            kind: kind of the module, which is the name of its section.
        """
        section = self.module_section(kind)
        own_s = None if section is None else section.start_timeout_s
        return self.supervisor.start_timeout_s if own_s is None else own_s
