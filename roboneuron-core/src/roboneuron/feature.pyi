"""Names of the core that features may use, by defining module; `feature.py` reads this file at run
time.
"""

# ruff: noqa: I001
from collections.abc import Mapping

# Modules, of which the names in `GROUPS` may be used.
from . import (
    estop as estop,
    log_files as log_files,
)
from .config import (
    models as models,
    reading as reading,
)
from .gate.motion import (
    joint_space as joint_space,
    task_space as task_space,
)
from .modules import (
    settings as settings,
)
from .plugins import (
    loading as loading,
)
from .ros import (
    messages as messages,
    topics as topics,
)

# Single names.
from .config.models import (
    Config as Config,
)
from .contract.profile import (
    check_topic as check_topic,
)
from .gate.roles import (
    Role as Role,
)
from .gate.audit import (
    AuditLog as AuditLog,
    AuditRecord as AuditRecord,
)
from .gate.motion.limiter import (
    MotionLimiter as MotionLimiter,
)
from .gate.motion.path import (
    Reach as Reach,
)
from .gate.motion.rules import (
    MotionRules as MotionRules,
    inspector_of as inspector_of,
    motion_rules as motion_rules,
)
from .modules.plugin import (
    build as build,
    load_profile as load_profile,
)
from .modules.report import (
    ModuleFacts as ModuleFacts,
    Report as Report,
)
from .modules.settings import (
    ModuleKind as ModuleKind,
)
from .planning import (
    KIND_ENTRIES as KIND_ENTRIES,
    Plan as Plan,
)
from .plugins.registry import (
    Registry as Registry,
)
from .ros.link import (
    Call as Call,
    RosLink as RosLink,
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
    StartForm as StartForm,
)
from .server.motion_gate import (
    Clamp as Clamp,
    ExposedEndpoint as ExposedEndpoint,
    GateRequest as GateRequest,
    MotionClaim as MotionClaim,
    MotionGate as MotionGate,
    Sent as Sent,
    TimedCommand as TimedCommand,
    Verdict as Verdict,
)
from .server.registry import (
    ToolRegistry as ToolRegistry,
)
from .server.schema import (
    Shape as Shape,
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
from .supervisor.lifecycle import (
    NodeClient as NodeClient,
)
from .supervisor.process import (
    ModuleProcess as ModuleProcess,
    read_tail as read_tail,
)
from .supervisor.slot import (
    Phase as Phase,
    Slot as Slot,
)

__all__: list[str]
GROUPS: Mapping[str, frozenset[str]]
