"""The file roboneuron.toml, parsed once into frozen models."""

from roboneuron.config.models import (
    Config,
    ControlConfig,
    InferenceConfig,
    LimitsConfig,
    PerceptionConfig,
    Reaction,
    RobotConfig,
    ServerConfig,
    SupervisorConfig,
    ZoneConfig,
)
from roboneuron.config.module_settings import ModuleSettings
from roboneuron.config.reading import (
    EMBEDDED_DEFAULT,
    check_sections,
    default_text,
    feature_options,
    fleet_feature,
    load_config,
    parse_config,
    parse_tables,
    read_state_directory,
    robot_folder,
    transport_feature,
)

__all__ = [
    "EMBEDDED_DEFAULT",
    "Config",
    "ControlConfig",
    "InferenceConfig",
    "LimitsConfig",
    "ModuleSettings",
    "PerceptionConfig",
    "Reaction",
    "RobotConfig",
    "ServerConfig",
    "SupervisorConfig",
    "ZoneConfig",
    "check_sections",
    "default_text",
    "feature_options",
    "fleet_feature",
    "load_config",
    "parse_config",
    "parse_tables",
    "read_state_directory",
    "robot_folder",
    "transport_feature",
]
