"""Names of the core that commands may use, by defining module; `command.py` reads this file at run
time.
"""

# ruff: noqa: I001
from collections.abc import Mapping

# Modules, of which the names in `GROUPS` may be used.
from . import (
    estop as estop,
    log_files as log_files,
)
from .cli import (
    state_folder as state_folder,
    terminal as terminal,
)
from .config import (
    reading as reading,
)
from .modules import (
    settings as settings,
)
from .plugins import (
    availability as availability,
    descriptor as descriptor,
    loading as loading,
)
from .ros import (
    environment as environment,
    messages as messages,
    qos as qos,
    topics as topics,
)

# Single names.
from .hang_watch import (
    HangWatch as HangWatch,
)
from .cli.main import (
    CommandModule as CommandModule,
    all_commands as all_commands,
    load_command as load_command,
    spoken as spoken,
)
from .config.models import (
    Config as Config,
)
from .config.reading import (
    feature_options as feature_options,
    load_config as load_config,
)
from .gate.roles import (
    Role as Role,
)
from .gate.audit import (
    AuditLog as AuditLog,
)
from .gate.motion.limiter import (
    MotionLimiter as MotionLimiter,
)
from .gate.motion.rules import (
    motion_rules as motion_rules,
    poses_of as poses_of,
)
from .modules.parent_watch import (
    Signals as Signals,
)
from .modules.plugin import (
    build as build,
    load_profile as load_profile,
)
from .modules.report import (
    Report as Report,
)
from .modules.settings import (
    ModuleKind as ModuleKind,
)
from .planning import (
    check_configuration as check_configuration,
)
from .plugins.discovery import (
    discover as discover,
    discover_from as discover_from,
)
from .plugins.registry import (
    Offer as Offer,
    PluginRecord as PluginRecord,
    Registry as Registry,
    Status as Status,
)
from .plugins.specs import (
    PLUGIN_KINDS as PLUGIN_KINDS,
)
from .ros.link import (
    RosLink as RosLink,
)
from .server.app import (
    make_served as make_served,
)
from .server.registry import (
    ERROR_META as ERROR_META,
)
from .supervisor.changes import (
    Periodic as Periodic,
)
from .supervisor.health import (
    EXPLANATIONS as EXPLANATIONS,
    FAULTS as FAULTS,
    Health as Health,
    ModuleView as ModuleView,
)

__all__: list[str]
GROUPS: Mapping[str, frozenset[str]]
