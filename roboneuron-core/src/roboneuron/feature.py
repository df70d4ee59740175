"""What features may use of the core in the process of the server, beside `roboneuron` itself.

`feature.pyi` lists the names; some are modules (`topics`, `roles`, ...), of which the names in
`GROUPS` may be used. A name is imported when it is first asked for. They change with minor
releases: CHANGELOG.md records it. `roboneuron.command` and `roboneuron.node` are the lists for
other processes; what none of the three lists is private. Plugins of devices, models and robots
need `roboneuron` alone.
"""

from collections.abc import Mapping

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "envelope": "EnvelopeError is_urgent",
        "estop": "EmergencyStopLatch",
        "joint_space": "JointLimit",
        "launching": "Connection",
        "loading": "load_options_model",
        "log_files": "PlainFormatter opener",
        "messages": "joints_from_message to_joint_trajectory",
        "models": "LimitsConfig Name Namespace Seconds",
        "reading": "parse_tables robot_folder",
        "settings": "EMERGENCY_STOP_TOPIC",
        "task_space": "TaskSpace",
        "topics": "ACTION DIAGNOSTICS JOINT_STATES is_written_by_modules",
    }.items()
}
"""What may be used of the modules among these names; a contract rule of packages checks it."""
