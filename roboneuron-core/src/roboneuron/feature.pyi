"""What features may use of the core, by the modules that define it; `feature.py` reads this at
run time.
"""

# ruff: noqa: I001
from .cli.commands import (
    COMMANDS as COMMANDS,
    CommandModule as CommandModule,
    installed_commands as installed_commands,
    load_command as load_command,
    spoken as spoken,
)
from .cli.terminal import (
    add_verbosity as add_verbosity,
    log_level as log_level,
)
from .config.models import (
    Config as Config,
    InferenceConfig as InferenceConfig,
    LimitsConfig as LimitsConfig,
    Name as Name,
    Namespace as Namespace,
    RobotConfig as RobotConfig,
    Seconds as Seconds,
    ZoneConfig as ZoneConfig,
)
from .config.reading import (
    default_text as default_text,
    feature_options as feature_options,
    load_config as load_config,
    parse_tables as parse_tables,
    read_state_directory as read_state_directory,
    robot_folder as robot_folder,
)
from .contract import (
    TOPIC_RULE as TOPIC_RULE,
)
from .contract.arrays import (
    F64 as F64,
)
from .contract.image import (
    READABLE_ENCODINGS as READABLE_ENCODINGS,
    U8 as U8,
)
from .contract.profile import (
    check_topic as check_topic,
)
from .errors import (
    nearest as nearest,
)
from .gate import (
    ROLES as ROLES,
)
from .gate.audit import (
    AUDIT_FILE as AUDIT_FILE,
    AuditLog as AuditLog,
    AuditRecord as AuditRecord,
)
from .gate.estop import (
    ESTOP_FILE as ESTOP_FILE,
    EmergencyStopLatch as EmergencyStopLatch,
    press_together as press_together,
)
from .gate.motion.joint_space import (
    JointLimit as JointLimit,
    SLACK as SLACK,
    joint_limits as joint_limits,
)
from .gate.motion.limiter import (
    MotionLimiter as MotionLimiter,
)
from .gate.motion.path import (
    Reach as Reach,
)
from .gate.motion.rules import (
    MotionRules as MotionRules,
    collision_of as collision_of,
    inspector_of as inspector_of,
    motion_rules as motion_rules,
)
from .gate.motion.task_space import (
    TaskSpace as TaskSpace,
    angle_rad as angle_rad,
    distance_m as distance_m,
)
from .gate.roles import (
    ADMIN as ADMIN,
    OPERATOR as OPERATOR,
    VIEWER as VIEWER,
    has_role as has_role,
)
from .log_files import (
    PlainFormatter as PlainFormatter,
    begin_logging as begin_logging,
    escaped as escaped,
    make_log_directory as make_log_directory,
    opener as opener,
)
from .modules.control import (
    ControlModule as ControlModule,
)
from .modules.execution import (
    Bounds as Bounds,
    ChunkExecutor as ChunkExecutor,
    Prediction as Prediction,
    Row as Row,
    rows_of as rows_of,
)
from .modules.inference import (
    InferenceModule as InferenceModule,
)
from .modules.module import (
    Module as Module,
)
from .modules.module_host import (
    Handover as Handover,
    ModuleHost as ModuleHost,
)
from .modules.parent_watch import (
    Signals as Signals,
)
from .modules.plugin import (
    build as build,
    load_profile as load_profile,
)
from .modules.settings import (
    EMERGENCY_STOP_TOPIC as EMERGENCY_STOP_TOPIC,
    FIRST_STEP_S as FIRST_STEP_S,
    FOLLOWING_NOTE as FOLLOWING_NOTE,
    GRIPPER_COMMANDED as GRIPPER_COMMANDED,
    HOLD_DURATION_S as HOLD_DURATION_S,
    HOLD_SHARE as HOLD_SHARE,
    LIMITS_PARAMETER as LIMITS_PARAMETER,
    MAX_INSTRUCTION_LENGTH as MAX_INSTRUCTION_LENGTH,
    MODULE_KINDS as MODULE_KINDS,
    ModuleKind as ModuleKind,
    SHORTEST_STEP_S as SHORTEST_STEP_S,
)
from .modules.status import (
    StatusWriter as StatusWriter,
)
from .planning import (
    Plan as Plan,
    check_plan as check_plan,
)
from .plugins.availability import (
    WHOLE as WHOLE,
    install_command as install_command,
    known_names as known_names,
    missing as missing,
    present as present,
)
from .plugins.descriptor import (
    NAME_PATTERN as NAME_PATTERN,
    check_spec as check_spec,
)
from .plugins.discovery import (
    discover as discover,
    discover_from as discover_from,
)
from .plugins.hookspecs import (
    PROJECT as PROJECT,
)
from .plugins.loading import (
    load_attribute as load_attribute,
    load_options as load_options,
    load_options_model as load_options_model,
    load_target as load_target,
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
from .ros.environment import (
    CLIENT_TOKEN as CLIENT_TOKEN,
    module_environment as module_environment,
    prepare_environment as prepare_environment,
    state_directory as state_directory,
)
from .ros.link import (
    Call as Call,
    RosLink as RosLink,
    UNSENT as UNSENT,
)
from .ros.messages import (
    intrinsics_from_camera_info as intrinsics_from_camera_info,
    joints_from_message as joints_from_message,
    to_image as to_image,
    to_joint_trajectory as to_joint_trajectory,
    to_ns as to_ns,
)
from .ros.qos import (
    NEWEST as NEWEST,
    STATUS as STATUS,
    requested_qos as requested_qos,
)
from .ros.topics import (
    ACTION as ACTION,
    DIAGNOSTICS as DIAGNOSTICS,
    EE_POSE as EE_POSE,
    JOINT_STATES as JOINT_STATES,
    PREDICTIONS as PREDICTIONS,
    camera_image as camera_image,
    camera_info as camera_info,
)
from .server.access import (
    HOLDER_KEY as HOLDER_KEY,
    Holder as Holder,
    LOCAL_PROCESS as LOCAL_PROCESS,
    check_role as check_role,
    is_local as is_local,
    may_call as may_call,
)
from .server.app import (
    Application as Application,
    instructions_for as instructions_for,
)
from .server.emergency import (
    SIGNAL as SIGNAL,
    press_on_signal as press_on_signal,
)
from .server.envelope import (
    BUSY as BUSY,
    EnvelopeError as EnvelopeError,
    check_id as check_id,
    is_urgent as is_urgent,
    repeated as repeated,
)
from .server.events import (
    Events as Events,
)
from .server.feature import (
    Features as Features,
    Transport as Transport,
)
from .server.host import (
    Modules as Modules,
    RosGraph as RosGraph,
)
from .server.lifecycle_tools import (
    EmergencyStopArguments as EmergencyStopArguments,
)
from .server.loop import (
    ClosedLoop as ClosedLoop,
    running_selection as running_selection,
)
from .server.module_kinds import (
    Instruction as Instruction,
    KIND_ENTRIES as KIND_ENTRIES,
    KindEntry as KindEntry,
    ModuleSection as ModuleSection,
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
from .server.motion_starts import (
    AGAIN as AGAIN,
    MotionStarts as MotionStarts,
)
from .server.plugins import (
    PluginCatalogue as PluginCatalogue,
)
from .server.registry import (
    ERROR_META as ERROR_META,
    ToolRegistry as ToolRegistry,
    failure as failure,
)
from .server.resources import (
    Resources as Resources,
)
from .server.results import (
    EmergencyStopResult as EmergencyStopResult,
    ModuleStatus as ModuleStatus,
    ModuleSummary as ModuleSummary,
    module_status as module_status,
    module_summary as module_summary,
)
from .server.schema import (
    Schema as Schema,
    Shape as Shape,
    no_choice as no_choice,
    parse as parse,
    unknown_name as unknown_name,
)
from .server.sections import (
    check_configuration as check_configuration,
)
from .server.selection import (
    Selection as Selection,
    check_instruction as check_instruction,
    configured_section as configured_section,
    plan_of as plan_of,
    select as select,
    takes_checkpoint as takes_checkpoint,
)
from .server.serving import (
    make_served as make_served,
)
from .server.surface import (
    make_server as make_server,
)
from .server.tool import (
    Stage as Stage,
    UnfinishedCallError as UnfinishedCallError,
)
from .supervisor.changes import (
    Changes as Changes,
    Event as Event,
    Lasting as Lasting,
    Periodic as Periodic,
)
from .supervisor.health import (
    EXPLANATIONS as EXPLANATIONS,
    FAULTS as FAULTS,
    Health as Health,
    ModuleView as ModuleView,
    Report as Report,
    assess as assess,
)
from .supervisor.launching import (
    Command as Command,
    Connection as Connection,
    module_command as module_command,
)
from .supervisor.lifecycle import (
    NodeClient as NodeClient,
)
from .supervisor.process import (
    ModuleProcess as ModuleProcess,
    read_tail as read_tail,
)
from .supervisor.slot import (
    Slot as Slot,
)
from .supervisor.supervisor import (
    Supervisor as Supervisor,
)

__all__: list[str]
