"""Names of the core that features and commands may use, by defining module; `feature.py` reads this
file at run time.
"""

# ruff: noqa: I001
from collections.abc import Mapping

# Modules, of which the names in `GROUPS` may be used.
from . import (
    estop as estop,
    log_files as log_files,
)
from .config import (
    reading as reading,
)
from .modules import (
    settings as settings,
)
from .ros import (
    topics as topics,
)
from .plugins import (
    loading as loading,
)

# Single names.
from .gate.motion import (
    LimitedCommand as LimitedCommand,
)
from .gate.motion.command import (
    Asked as Asked,
)
from .modules.module_host import (
    Module as Module,
    ModuleHost as ModuleHost,
)
from .config.models import (
    Config as Config,
)
from .contract.profile import (
    check_topic as check_topic,
)
from .gate.roles import (
    Role as Role,
)
from .gate.stillness import (
    StillReason as StillReason,
)
from .gate.audit import (
    AuditLog as AuditLog,
    AuditRecord as AuditRecord,
)
from .gate.motion.limiter import (
    MotionLimiter as MotionLimiter,
)
from .gate.motion.rules import (
    MotionRules as MotionRules,
    motion_rules as motion_rules,
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
    Plan as Plan,
)
from .plugins.registry import (
    Registry as Registry,
)
from .server.app import (
    Application as Application,
)
from .server.host import (
    Events as Events,
)
from .server.interception import (
    CallPhase as CallPhase,
    EndedCall as EndedCall,
    IncomingCall as IncomingCall,
    Interceptor as Interceptor,
    Proceed as Proceed,
    Simulator as Simulator,
)
from .server.loop import (
    ClosedLoop as ClosedLoop,
)
from .server.motion_gate import (
    ExposedEndpoint as ExposedEndpoint,
    GateRequest as GateRequest,
    MotionGate as MotionGate,
    TimedCommand as TimedCommand,
)
from .server.registry import (
    ToolRegistry as ToolRegistry,
)
from .server.surface import (
    make_server as make_server,
)
from .server.tool import (
    Answer as Answer,
    Holder as Holder,
)
from .supervisor.changes import (
    Periodic as Periodic,
    Stage as Stage,
)
from .supervisor.connection import (
    Connection as Connection,
)
from .supervisor.health import (
    EXPLANATIONS as EXPLANATIONS,
    FAULTS as FAULTS,
    Health as Health,
    Modules as Modules,
    ModuleView as ModuleView,
)

__all__: list[str]
GROUPS: Mapping[str, frozenset[str]]
