"""What features and commands may use of the core, beside `roboneuron` itself; the rest of it is
private.

Plugins of devices, models and robots need `roboneuron` alone. `feature.pyi` lists the names; some
are modules (`topics`, `roles`, ...), of which the names in `GROUPS` may be used. A name is imported
when it is first asked for. They change with minor releases: CHANGELOG.md records it.
"""

import ast
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

# lazy_loader would keep each name in the package `roboneuron` too, where some mean something else.
_MODULES = {
    alias.name: f"roboneuron.{node.module}" if node.module else "roboneuron"
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom) and node.level
    for alias in node.names
}
__all__ = sorted(_MODULES)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "access": "Holder check_role may_call",
        "availability": "install_command missing present",
        "descriptor": "NAME_PATTERN check_spec",
        "emergency": "press_on_signal",
        "envelope": "EnvelopeError check_id is_urgent",
        "environment": "CLIENT_TOKEN module_environment prepare_environment state_directory",
        "estop": "EmergencyStopLatch press_together",
        "joint_space": "JointLimit SLACK joint_limits",
        "launching": "Command Connection",
        "loading": "load_attribute load_options load_options_model load_target",
        "log_files": "PlainFormatter begin_logging escaped make_log_directory opener",
        "messages": "frame_from_message intrinsics_from_camera_info joints_from_message "
        "pose_from_message to_action_message to_camera_info to_image to_joint_trajectory to_ns",
        "models": "ControlConfig InferenceConfig LimitsConfig Name Namespace Seconds ZoneConfig",
        "qos": "NEWEST STATUS requested_qos",
        "reading": "default_text parse_tables read_state_directory robot_folder",
        "results": "EmergencyStopResult ModuleStatus ModuleSummary",
        "roles": "ADMIN OPERATOR ROLES VIEWER has_role",
        "schema": "no_choice parse unknown_name",
        "settings": "EMERGENCY_STOP_TOPIC FIRST_STEP_S FUTURE_S HOLD_DURATION_S HOLD_SHARE "
        "INSTRUCTION_PARAMETER MAX_INSTRUCTION_LENGTH SHORTEST_STEP_S instruction_problem",
        "task_space": "TaskSpace angle_rad distance_m",
        "terminal": "add_verbosity log_level",
        "topics": "ACTION DIAGNOSTICS EE_POSE JOINT_STATES PREDICTIONS camera_image camera_info "
        "is_written_by_modules",
    }.items()
}
"""What may be used of the modules among these names; a contract rule of packages checks it."""


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(_MODULES[name])
    if not hasattr(module, name):  # a module that nobody has imported yet
        import_module(f"{_MODULES[name]}.{name}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return __all__
