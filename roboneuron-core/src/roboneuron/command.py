"""What commands may use of the core, beside `roboneuron` itself: they are processes of their own,
beside a server or without one.

See `roboneuron.feature` for how to use such a list.
"""

from collections.abc import Mapping

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "availability": "install_command known_names missing present",
        "descriptor": "NAME_PATTERN check_spec",
        "environment": "CLIENT_TOKEN module_environment prepare_environment state_directory",
        "estop": "EmergencyStopLatch",
        "loading": "load_attribute load_options load_options_model load_target",
        "log_files": "begin_logging escaped opener",
        "messages": "intrinsics_from_camera_info joints_from_message to_image to_ns",
        "qos": "requested_qos",
        "reading": "default_text read_state_directory robot_folder",
        "settings": "EMERGENCY_STOP_TOPIC HOLD_DURATION_S",
        "terminal": "add_verbosity log_level",
        "topics": "ACTION DIAGNOSTICS JOINT_STATES",
    }.items()
}
"""What may be used of the modules among these names; a contract rule of packages checks it."""
