"""A whole roboneuron.toml as one frozen model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from roboneuron.config.limits import LimitsConfig
from roboneuron.config.modules import (
    ControlConfig,
    InferenceConfig,
    PerceptionConfig,
    RobotConfig,
    SupervisorConfig,
)
from roboneuron.config.section import Section
from roboneuron.config.serving import ServerConfig

CHECKPOINT_START_S = 900.0
"""15 GB from a slow disk, and the warm-up of a large model, take several minutes."""


class Config(Section):
    """A whole roboneuron.toml."""

    robot: RobotConfig
    perception: PerceptionConfig | None = None
    inference: InferenceConfig | None = None
    control: ControlConfig | None = None
    limits: LimitsConfig = LimitsConfig()
    supervisor: SupervisorConfig = SupervisorConfig()
    server: ServerConfig = ServerConfig()
    disabled_plugins: tuple[str, ...] = Field(default=(), strict=False, description="distributions not to load")
    features: tuple[str, ...] = Field(
        default=(), strict=False, description="features without which the server does not start"
    )
    plugins: dict[str, dict[str, Any]] = Field(default_factory=dict, description="options by plugin name")
    sections: dict[str, Any] = Field(default_factory=dict, exclude=True)
    """Sections of features by top-level key, as in the file; modules are not told them."""

    @property
    def namespace(self) -> str:
        """ROS namespace of the robot, without a leading slash."""
        return self.robot.namespace or self.robot.name.replace("-", "_")

    def options(self, name: str) -> Mapping[str, object]:
        """Options of the backend, source, controller, driver ... called `name`; empty when the user set none."""
        return self.plugins.get(name, {})

    def start_timeout_s(self, kind: str) -> float:
        """Longest start of the module called `kind` [s]."""
        section = getattr(self, kind)
        if section is not None and section.start_timeout_s is not None:
            return float(section.start_timeout_s)
        if kind == "inference" and self.inference is not None and self.inference.checkpoint is not None:
            return max(CHECKPOINT_START_S, self.supervisor.start_timeout_s)
        return self.supervisor.start_timeout_s
