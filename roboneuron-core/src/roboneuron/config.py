"""roboneuron.toml, read once at the border into frozen models; an unknown key is an error with a suggestion."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from roboneuron.errors import ConfigurationError

EMBEDDED_DEFAULT = "the embedded default"
"""How messages call the configuration that is used when the user gives none."""

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=64)]
CameraName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]
Namespace = Annotated[str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*(/[a-zA-Z][a-zA-Z0-9_]*)*$", max_length=128)]
EndpointName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,47}$")]
Seconds = Annotated[float, Field(gt=0, le=3600)]
Share = Annotated[float, Field(gt=0, le=1)]
Point = Annotated[list[Annotated[float, Field(ge=-100, le=100)]], Field(min_length=3, max_length=3)]
Reaction = Literal["hold", "scale", "refuse"]
"""At a limit: stop where the arm is measured, shorten the command, or send nothing and let the last command end."""
Range = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


Restart = Literal["never", "on_failure"]
Megabytes = Annotated[int, Field(ge=64, le=10_000_000)]
_MEMORY = "a module that holds more memory of its own is ended; no limit when not given"


class RobotConfig(_Section):
    """`[robot]`: which robot, moved how."""

    name: Name = Field(description="a robot offered by an installed plugin")
    driver: Name = Field(default="simulated", description="one of the robot's drivers")
    namespace: Namespace | None = Field(default=None, description="ROS namespace; the robot's name when not given")
    command_timeout_s: Seconds = Field(default=1.0, description="the driver holds when commands cease for this long")
    restart: Restart = Field(default="never", description="whether it comes back by itself; then it may move again")
    state_rate_hz: Annotated[float, Field(ge=10, le=1000)] = Field(default=120.0, description="rate of joint_states")
    python: str | None = Field(default=None, description="interpreter of the module's own environment")
    memory_limit_mb: Megabytes | None = Field(default=None, description=_MEMORY)


class PerceptionConfig(_Section):
    """`[perception]`: where images come from."""

    source: Name = Field(description="a perception source offered by an installed plugin")
    restart: Restart = Field(default="on_failure", description="whether it comes back by itself")
    cameras: tuple[CameraName, ...] = Field(
        default=(), strict=False, description="names of the robot's cameras to serve; all of them when empty"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")
    memory_limit_mb: Megabytes | None = Field(default=None, description=_MEMORY)


class InferenceConfig(_Section):
    """`[inference]`: which policy runs, and how."""

    backend: Name = Field(description="a backend offered by an installed plugin")
    restart: Restart = Field(default="never", description="whether it comes back by itself; then it acts again")
    checkpoint: str | None = Field(default=None, description="directory of the model's files")
    runtime: Name | None = Field(default=None, description="runtime; the backend's own default when not given")
    acceleration: Name | None = Field(default=None, description="acceleration preset; none when not given")
    instruction: str = Field(default="", description="what to do; can be set later")
    cameras: dict[str, CameraName] = Field(default_factory=dict, description="camera name by role of the backend")
    max_image_age_s: Seconds = Field(default=0.5, description="older images are never acted on")
    switch_max_difference: Annotated[float, Field(gt=0)] = Field(
        default=0.25, description="a warm switch to actions that differ more [m or rad] is refused"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")
    memory_limit_mb: Megabytes | None = Field(default=None, description=_MEMORY)


class ControlConfig(_Section):
    """`[control]`: how actions become joint commands."""

    controller: Name = Field(description="a controller offered by an installed plugin")
    restart: Restart = Field(default="never", description="whether it comes back by itself; then it may move the arm")
    action_timeout_s: Seconds = Field(default=0.5, description="older actions are dropped; then the arm holds")
    state_timeout_s: Seconds = Field(default=0.25, description="older joint states stop the arm")
    server_timeout_s: Seconds = Field(default=2.0, description="the arm holds when the server is frozen this long")
    command: Literal["joint_trajectory", "joint_state"] = Field(
        default="joint_trajectory", description="message type of the command topic"
    )
    switch_max_difference: Annotated[float, Field(gt=0)] = Field(
        default=0.05, description="a warm switch to commands or TCP poses that differ more [rad or m] is refused"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")
    memory_limit_mb: Megabytes | None = Field(default=None, description=_MEMORY)


class ZoneConfig(_Section):
    """One entry of `limits.zones`."""

    name: str = Field(min_length=1, max_length=64, description="named in reports")
    lower_m: Point = Field(description="corner [x, y, z] in the base frame")
    upper_m: Point = Field(description="opposite corner")


class LimitsConfig(_Section):
    """`[limits]`: what control may send, whatever it is asked; see docs/safety.md."""

    velocity_fraction: Share = Field(default=1.0, description="share of the joints' velocity limits in use")
    acceleration_fraction: Share = Field(default=1.0, description="share of their acceleration limits in use")
    max_step_m: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="farthest the TCP may go per action"
    )
    max_step_rad: Annotated[float, Field(gt=0, le=3)] = Field(
        default=0.5, description="farthest it may turn per action"
    )
    max_speed_m_s: Annotated[float, Field(gt=0, le=3)] = Field(default=0.5, description="fastest motion of the TCP")
    max_turn_rad_s: Annotated[float, Field(gt=0, le=10)] = Field(default=2.5, description="fastest turn of the TCP")
    workspace_lower_m: Point | None = Field(
        default=None, description="corner of the TCP's box in the base frame; the robot's own when not given"
    )
    workspace_upper_m: Point | None = Field(default=None, description="opposite corner")
    min_height_m: Annotated[float, Field(ge=-100, le=100)] | None = Field(
        default=None, description="lowest z of the TCP in the base frame"
    )
    zones: tuple[ZoneConfig, ...] = Field(
        default=(),
        strict=False,
        description="boxes that the TCP must not enter: tables of `name`, `lower_m`, `upper_m`",
    )
    min_singular_value: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.02, description="distance from a singularity: smallest singular value of the TCP's Jacobian"
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
    on_collision: Reaction = Field(default="hold", description="self-collision, where the controller checks it")


class SupervisorConfig(_Section):
    """`[supervisor]`: bounds on starting and stopping processes."""

    start_timeout_s: Seconds = Field(default=60.0, description="spawn until proof of readiness (loading included)")
    stop_timeout_s: Seconds = Field(default=5.0, description="deactivate and SIGTERM before SIGKILL")
    unresponsive_s: Seconds = Field(default=2.0, description="frozen for this long, a module may be restarted")
    restart_backoff_s: Annotated[float, Field(ge=0, le=600)] = Field(
        default=0.5, description="wait before a restart; doubled by each one before it"
    )
    restart_limit: Annotated[int, Field(ge=0, le=100)] = Field(default=3, description="most restarts in one window")
    restart_window_s: Seconds = Field(default=120.0, description="restarts longer ago do not count")
    state_directory: str | None = Field(default=None, description="logs, latch and audit; XDG state when not given")


class TokenConfig(_Section):
    """One entry of `server.tokens`: where a bearer token is found, never the token itself."""

    name: Name = Field(description="who holds it; for the audit")
    role: Literal["viewer", "operator", "admin"] = Field(description="read; also move; also reset the emergency stop")
    variable: str | None = Field(default=None, max_length=128, description="environment variable that holds it")
    file: str | None = Field(default=None, description="or a file that only its owner can read")


class ServerConfig(_Section):
    """`[server]`: how agents connect."""

    name: str = Field(default="roboneuron", description="server name that MCP clients see")
    transport: Literal["stdio", "http"] = Field(default="stdio", description="http: streamable HTTP, at /mcp")
    host: str = Field(default="127.0.0.1", min_length=1, max_length=253, description="address that http listens on")
    port: Annotated[int, Field(ge=0, le=65535)] = Field(default=8765, description="port of http; 0: any free one")
    allowed_hosts: tuple[str, ...] = Field(
        default=(), strict=False, description="names that clients use for this machine, besides `host`"
    )
    allowed_origins: tuple[str, ...] = Field(
        default=(), strict=False, description="web pages that may connect, such as https://panel.lan"
    )
    lease_s: Seconds | None = Field(
        default=None, description="motion ends when its operator makes no call for this long; none: never"
    )
    max_request_bytes: Annotated[int, Field(ge=1024, le=1 << 28)] = Field(
        default=4 << 20, description="largest request over http"
    )
    max_concurrent_calls: Annotated[int, Field(ge=1, le=10000)] = Field(
        default=64, description="most tool calls at once; stops are always taken"
    )
    tokens: tuple[TokenConfig, ...] = Field(
        default=(), strict=False, description="who may connect over http: tables of `name`, `role`, `variable`, `file`"
    )


class ExposeConfig(_Section):
    """`[[expose]]`: a ROS interface that agents may use directly, or limits on one that the robot's profile exposes."""

    robot: Name | None = Field(default=None, description="whose it is; the configured robot when not given")
    namespace: Namespace | None = Field(
        default=None, description="ROS namespace of that robot; by default its name with underscores"
    )
    name: EndpointName | None = Field(
        default=None, description="short noun in the tools' names; without it the robot's whole profile is exposed"
    )
    kind: Literal["publish", "read", "service", "action", "parameters"] | None = Field(
        default=None, description="what agents may do; as in the robot's profile when not given"
    )
    topic: str | None = Field(
        default=None, max_length=200, description="topic, service, action or node; absolute or in the namespace"
    )
    type: str | None = Field(default=None, description="package/msg/Name, package/srv/Name or package/action/Name")
    summary: str = Field(default="", max_length=500, description="one line for the agent")
    bounds: dict[str, Range] = Field(default_factory=dict, description="[lowest, highest] by field path")
    rate_hz: Annotated[float, Field(gt=0, le=1000)] | None = Field(default=None, description="most calls per second")
    clamp: tuple[str, ...] = Field(default=(), strict=False, description="fields that are clamped instead of refused")
    nonfinite: tuple[str, ...] = Field(default=(), strict=False, description="fields that may hold NaN and infinities")
    stop_message: Literal["", "zero"] | dict[str, Any] = Field(
        default="", description='ends every motion: "zero", or the message itself'
    )
    repeat_hz: Annotated[float, Field(ge=0, le=100)] | None = Field(
        default=None, description="a lasting value is sent again this often"
    )
    require_subscriber: bool = Field(default=True, description="a message that nobody receives is an error")
    moves: bool = Field(default=True, description="false: it moves nothing and may be used while a policy runs")


class DiscoverConfig(_Section):
    """`[[discover]]`: interfaces of the live ROS graph that agents may use without being listed one by one."""

    pattern: str = Field(min_length=2, max_length=200, pattern=r"^/[A-Za-z0-9_/*?]+$", description="such as /arm/*")
    kinds: tuple[Literal["read", "publish", "service", "action"], ...] = Field(
        default=("read",), strict=False, description="what agents may do with what matches"
    )
    robot: Name | None = Field(default=None, description="whose it is; the configured robot when not given")
    rate_hz: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=10.0, description="most calls per second of each endpoint"
    )
    limits: dict[str, dict[str, Range]] = Field(
        default_factory=dict,
        description='[lowest, highest] by field path, by type; `"*"` is every other number of the type',
    )
    unlimited: tuple[str, ...] = Field(
        default=(), strict=False, description="types whose numbers may be sent though nothing limits them"
    )
    period_s: Annotated[float, Field(ge=0.1, le=60)] = Field(default=1.0, description="how often it is looked at")
    most: Annotated[int, Field(ge=1, le=2000)] = Field(default=200, description="most endpoints of this pattern")


class DirectConfig(_Section):
    """`[direct]`: the tools that are derived from ROS interfaces."""

    profile: bool = Field(default=True, description="expose the endpoints of the robot's profile")
    dry_run: bool = Field(default=False, description="answer what would happen, send nothing")
    listed_tools: Annotated[int, Field(ge=0, le=10000)] = Field(
        default=100, description="more derived tools than this are reached by find_tools and call_endpoint"
    )
    max_duration_s: Seconds = Field(default=120.0, description="longest motion, sequence or goal")
    ee_speed_m_s: Annotated[float, Field(gt=0, le=1)] = Field(default=0.25, description="fastest end-effector move")
    ee_turn_rad_s: Annotated[float, Field(gt=0, le=3)] = Field(default=1.0, description="fastest end-effector turn")


class Config(_Section):
    """A whole roboneuron.toml."""

    robot: RobotConfig
    perception: PerceptionConfig | None = None
    inference: InferenceConfig | None = None
    control: ControlConfig | None = None
    limits: LimitsConfig = LimitsConfig()
    supervisor: SupervisorConfig = SupervisorConfig()
    server: ServerConfig = ServerConfig()
    direct: DirectConfig = DirectConfig()
    expose: tuple[ExposeConfig, ...] = Field(default=(), strict=False, description="see `[[expose]]`")
    discover: tuple[DiscoverConfig, ...] = Field(default=(), strict=False, description="see `[[discover]]`")
    disabled_plugins: tuple[str, ...] = Field(default=(), strict=False, description="distributions not to load")
    plugins: dict[str, dict[str, Any]] = Field(default_factory=dict, description="options by plugin name")

    @property
    def namespace(self) -> str:
        """ROS namespace of the robot, without a leading slash."""
        return self.robot.namespace or self.robot.name.replace("-", "_")

    def options(self, name: str) -> Mapping[str, object]:
        """Options of the backend, source, controller, driver ... called `name`; empty when the user set none."""
        return self.plugins.get(name, {})


def _valid_keys(location: tuple[int | str, ...]) -> list[str]:
    """Keys allowed in the section that `location` (of an error) points into."""
    model: Any = Config
    for part in location[:-1]:
        if isinstance(part, int):  # an entry of an array of tables
            continue
        field = model.model_fields.get(part) if hasattr(model, "model_fields") else None
        if field is None:
            return []
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
        candidates += [a for c in candidates for a in getattr(c, "__args__", ())]
        model = next((c for c in candidates if hasattr(c, "model_fields")), None)
        if model is None:
            return []
    return sorted(model.model_fields)


def _explain(error: ValidationError, source: str) -> ConfigurationError:
    lines = []
    for item in error.errors(include_url=False):
        location = item["loc"]
        key = ".".join(str(part) for part in location)
        if item["type"] == "extra_forbidden":
            valid = _valid_keys(location)
            near = get_close_matches(str(location[-1]), valid, n=1, cutoff=0.5)
            nearest = f" Did you mean {near[0]!r}?" if near else f" Valid keys: {', '.join(valid)}."
            lines.append(f"{source}: unknown key {key!r}.{nearest}")
        elif item["type"] == "missing":
            lines.append(f"{source}: {key!r} is missing.")
        else:
            lines.append(f"{source}: {key} = {item['input']!r}: {item['msg'][0].lower()}{item['msg'][1:]}.")
    return ConfigurationError("\n".join(lines))


def parse_config(text: str, *, source: str = "roboneuron.toml") -> Config:
    """Parse the text of a roboneuron.toml.

    Args:
        text: TOML.
        source: file name for messages.

    Raises:
        ConfigurationError: not TOML, or a key or value is not valid; names file, key and the nearest valid key.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source} is not valid TOML: {error}.") from error
    try:
        return Config.model_validate(raw)
    except ValidationError as error:
        raise _explain(error, source) from error


def default_text() -> str:
    """Text of the embedded default configuration."""
    return files("roboneuron").joinpath("data/default.toml").read_text(encoding="utf-8")


def load_config(path: Path | None = None) -> Config:
    """Read `path`, or the embedded default when None.

    Raises:
        ConfigurationError: the file cannot be read or is not valid.
    """
    if path is None:
        return parse_config(default_text(), source=EMBEDDED_DEFAULT)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}.") from error
    return parse_config(text, source=str(path))
