"""Topic names of the contract, relative to the robot's namespace."""

import re

ACTION = "action"
JOINT_STATES = "joint_states"
EE_POSE = "ee_pose"
PREDICTIONS = "predictions"
"""std_msgs/String: each prediction as a feature describes it, see
`InferenceModule.on_prediction`.
"""
JOINT_TRAJECTORY = "joint_trajectory"
JOINT_COMMAND = "joint_command"
DIAGNOSTICS = "/diagnostics"


def is_written_by_modules(topic: str) -> bool:
    """Whether a module of the core publishes a topic that is named below the robot's namespace."""
    return _WRITTEN.fullmatch(topic) is not None


def camera_image(name: str) -> str:
    """Topic of a camera's images."""
    return f"camera/{name}/image"


def camera_info(name: str) -> str:
    """Topic of a camera's calibration, one message for each image."""
    return f"camera/{name}/camera_info"


_WRITTEN = re.compile(
    "|".join(
        (ACTION, JOINT_STATES, EE_POSE, PREDICTIONS, camera_image("[^/]+"), camera_info("[^/]+"))
    )
)
