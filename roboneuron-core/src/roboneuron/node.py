"""Names of the core that features may use in a module's process, in addition to `roboneuron`: in
their module classes (`FeatureSpec.module`) and in functions called there (`on_join`).

See `roboneuron.feature` for the use of such a list.
"""

from collections.abc import Mapping

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
GROUPS: Mapping[str, frozenset[str]] = {
    name: frozenset(names.split())
    for name, names in {
        "loading": "load_attribute",
        "messages": "PlannedRows intrinsics_from_camera_info joints_from_message "
        "row_from_action_message to_action_message to_image to_ns to_pose_stamped",
        "models": "ControlConfig",
        "qos": "NEWEST",
        "settings": "FUTURE_S INSTRUCTION_PARAMETER LIMITS_PARAMETER",
        "task_space": "angle_rad distance_m",
        "topics": "ACTION EE_POSE JOINT_STATES PREDICTIONS camera_image camera_info",
    }.items()
}
"""Public names of these modules; checked by a contract rule of packages."""
