"""roboneuron.toml, read once at the border into frozen models."""

# fmt: off
# ruff: noqa: I001
from roboneuron.config.models import (
    Config, ControlConfig, InferenceConfig, LimitsConfig, PerceptionConfig, Reaction, RobotConfig, ServerConfig,
    SupervisorConfig, ZoneConfig,
)
from roboneuron.config.reading import (
    EMBEDDED_DEFAULT, STDIO, check_sections, default_text, feature_options, fleet_feature, load_config, parse_config,
    parse_tables, read_state_directory, robot_folder, transport_feature,
)

__all__ = [
    "EMBEDDED_DEFAULT", "STDIO", "Config", "ControlConfig", "InferenceConfig", "LimitsConfig", "PerceptionConfig",
    "Reaction", "RobotConfig", "ServerConfig", "SupervisorConfig", "ZoneConfig", "check_sections", "default_text",
    "feature_options", "fleet_feature", "load_config", "parse_config", "parse_tables", "read_state_directory",
    "robot_folder", "transport_feature",
]
