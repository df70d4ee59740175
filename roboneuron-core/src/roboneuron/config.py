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
Seconds = Annotated[float, Field(gt=0, le=3600)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class RobotConfig(_Section):
    """`[robot]`: which robot, moved how."""

    name: Name = Field(description="a robot offered by an installed plugin")
    driver: Name = Field(default="simulated", description="one of the robot's drivers")
    namespace: Namespace | None = Field(default=None, description="ROS namespace; the robot's name when not given")
    command_timeout_s: Seconds = Field(default=1.0, description="the driver holds when commands cease for this long")
    state_rate_hz: Annotated[float, Field(ge=10, le=1000)] = Field(default=120.0, description="rate of joint_states")
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class PerceptionConfig(_Section):
    """`[perception]`: where images come from."""

    source: Name = Field(description="a perception source offered by an installed plugin")
    cameras: tuple[CameraName, ...] = Field(
        default=(), strict=False, description="names of the robot's cameras to serve; all of them when empty"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class InferenceConfig(_Section):
    """`[inference]`: which policy runs, and how."""

    backend: Name = Field(description="a backend offered by an installed plugin")
    checkpoint: str | None = Field(default=None, description="directory of the model's files")
    runtime: Name | None = Field(default=None, description="runtime; the backend's own default when not given")
    acceleration: Name | None = Field(default=None, description="acceleration preset; none when not given")
    instruction: str = Field(default="", description="what to do; can be set later")
    cameras: dict[str, CameraName] = Field(default_factory=dict, description="camera name by role of the backend")
    max_image_age_s: Seconds = Field(default=0.5, description="older images are never acted on")
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class ControlConfig(_Section):
    """`[control]`: how actions become joint commands."""

    controller: Name = Field(description="a controller offered by an installed plugin")
    action_timeout_s: Seconds = Field(default=0.5, description="older actions are dropped; then the arm holds")
    state_timeout_s: Seconds = Field(default=0.25, description="older joint states stop the arm")
    command: Literal["joint_trajectory", "joint_state"] = Field(
        default="joint_trajectory", description="message type of the command topic"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class SupervisorConfig(_Section):
    """`[supervisor]`: bounds on starting and stopping processes."""

    start_timeout_s: Seconds = Field(default=60.0, description="spawn until proof of readiness (loading included)")
    stop_timeout_s: Seconds = Field(default=5.0, description="deactivate and SIGTERM before SIGKILL")
    state_directory: str | None = Field(default=None, description="logs, latch and audit; XDG state when not given")


class ServerConfig(_Section):
    """`[server]`: how agents connect."""

    name: str = Field(default="roboneuron", description="server name that MCP clients see")


class Config(_Section):
    """A whole roboneuron.toml."""

    robot: RobotConfig
    perception: PerceptionConfig | None = None
    inference: InferenceConfig | None = None
    control: ControlConfig | None = None
    supervisor: SupervisorConfig = SupervisorConfig()
    server: ServerConfig = ServerConfig()
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
        field = model.model_fields.get(part) if hasattr(model, "model_fields") else None
        if field is None:
            return []
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
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
