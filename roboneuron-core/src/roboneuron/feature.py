"""Names of the core that features, in the server's process and in modules, and commands may use in
addition to `roboneuron`.

`feature.pyi` lists the names; some are modules (`topics`, `settings`, ...), of which the names in
`GROUPS` may be used. A name is imported on first use. They change with minor releases, recorded in
CHANGELOG.md. `roboneuron.command` lists what only commands may use; a module of the core may
publish names in its `__all__`; all others are private. Plugins of devices, models and robots need
`roboneuron` only.
"""

from collections.abc import Mapping

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "estop": "EmergencyStopLatch",
        "loading": "load_attribute load_options load_options_model load_target",
        "log_files": "PlainFormatter begin_logging opener read_tail",
        "reading": "default_text parse_tables read_tables robot_folder",
        "settings": "EMERGENCY_STOP_TOPIC FOREIGN_REQUEST HOLD_DURATION_S INSTRUCTION_PARAMETER",
        "topics": "ACTION DIAGNOSTICS JOINT_STATES PREDICTIONS",
    }.items()
}
"""Public names of these modules; checked by a contract rule of packages."""
