"""Names of the core that features may use in the server's process and in modules, in addition to
`roboneuron`.

`feature.pyi` lists the names; some are modules (`topics`, `settings`, ...), of which the names in
`GROUPS` may be used. A name is imported on first use. They change with minor releases, recorded in
CHANGELOG.md. `roboneuron.command` is the list for commands; a module of the core may publish names
in its `__all__`; all others are private. Plugins of devices, models and robots need `roboneuron`
only.
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
        "log_files": "PlainFormatter opener read_tail",
        "models": "Name Seconds",
        "reading": "parse_tables robot_folder",
        "settings": "FOREIGN_REQUEST INSTRUCTION_PARAMETER",
        "topics": "PREDICTIONS",
    }.items()
}
"""Public names of these modules; checked by a contract rule of packages."""
