"""Names of the core that commands may use in addition to `roboneuron` and `roboneuron.feature`;
commands are separate processes, with or without a server.

See `roboneuron.feature` for the use of such a list.
"""

from collections.abc import Mapping

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "availability": "known_names present",
        "descriptor": "NAME_PATTERN check_spec",
        "environment": "CLIENT_TOKEN module_environment prepare_environment state_directory",
        "messages": "intrinsics_from_camera_info to_image",
        "qos": "requested_qos",
        "state_folder": "add_arguments folders_of",
        "terminal": "is_agreed log_level",
    }.items()
}
"""Public names of these modules; checked by a contract rule of packages."""
