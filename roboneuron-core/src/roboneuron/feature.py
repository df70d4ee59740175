"""Names of the core that features may use in the server's process, in addition to `roboneuron`.

`feature.pyi` lists the names; some are modules (`topics`, `roles`, ...), of which the names in
`GROUPS` may be used. A name is imported on first use. They change with minor releases, recorded in
CHANGELOG.md. `roboneuron.command` and `roboneuron.node` are the lists for other processes; names in
none of the three lists are private. Plugins of devices, models and robots need `roboneuron` only.
"""

from collections.abc import Mapping

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "estop": "EmergencyStopLatch",
        "joint_space": "JointLimit",
        "loading": "load_options_model",
        "log_files": "PlainFormatter opener",
        "messages": "intrinsics_from_camera_info joints_from_message to_joint_trajectory",
        "models": "LimitsConfig Name Namespace Seconds",
        "reading": "parse_tables robot_folder",
        "settings": "EMERGENCY_STOP_TOPIC FOREIGN_REQUEST",
        "task_space": "TaskSpace",
        "topics": "ACTION DIAGNOSTICS JOINT_STATES is_written_by_modules",
    }.items()
}
"""Public names of these modules; checked by a contract rule of packages."""
