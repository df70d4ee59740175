"""roboneuron.toml, read once at the border into frozen models."""

from __future__ import annotations

from roboneuron.config.limits import LimitsConfig, ZoneConfig
from roboneuron.config.modules import (
    ControlConfig,
    InferenceConfig,
    PerceptionConfig,
    RobotConfig,
    SupervisorConfig,
)
from roboneuron.config.reading import EMBEDDED_DEFAULT, default_text, load_config, parse_config
from roboneuron.config.section import Reaction
from roboneuron.config.serving import DirectConfig, DiscoverConfig, ExposeConfig, ServerConfig
from roboneuron.config.whole import Config

__all__ = [
    "EMBEDDED_DEFAULT",
    "Config",
    "ControlConfig",
    "DirectConfig",
    "DiscoverConfig",
    "ExposeConfig",
    "InferenceConfig",
    "LimitsConfig",
    "PerceptionConfig",
    "Reaction",
    "RobotConfig",
    "ServerConfig",
    "SupervisorConfig",
    "ZoneConfig",
    "default_text",
    "load_config",
    "parse_config",
]
