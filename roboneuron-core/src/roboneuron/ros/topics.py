"""Topic names of the contract, relative to the robot's namespace."""

import re

ACTION = "action"
"""std_msgs/Float64MultiArray, from inference to control: one action."""
JOINT_STATES = "joint_states"
"""sensor_msgs/JointState, from the robot: measured joints, by name."""
EE_POSE = "ee_pose"
"""geometry_msgs/PoseStamped, from control: the measured TCP in the base frame."""
PREDICTIONS = "predictions"
"""std_msgs/String: description of each prediction by a feature, see
`StepFilter.note_answer`.
"""
JOINT_TRAJECTORY = "joint_trajectory"
"""trajectory_msgs/JointTrajectory, to the robot."""
JOINT_COMMAND = "joint_command"
"""sensor_msgs/JointState, to the robot: the alternative to `JOINT_TRAJECTORY`, see
`control.command`.
"""
DIAGNOSTICS = "/diagnostics"
"""diagnostic_msgs/DiagnosticArray, from every module; absolute, as ROS tools expect it."""


def is_written_by_modules(topic: str) -> bool:
    """True if a module of the core publishes this topic, named relative to the robot's
    namespace.
    """
    return _WRITTEN.fullmatch(topic) is not None


def camera_image(name: str) -> str:
    """Image topic of a camera."""
    return f"camera/{name}/image"


def camera_info(name: str) -> str:
    """Calibration topic of a camera, one message for each image."""
    return f"camera/{name}/camera_info"


def camera_depth(name: str) -> str:
    """Depth topic of a camera, for sources that measure it: one message for each image, with its
    stamp; 32FC1 [m].
    """
    return f"camera/{name}/depth"


_OF_CAMERAS = (camera_image, camera_info, camera_depth)
_WRITTEN = re.compile(
    "|".join(
        (ACTION, JOINT_STATES, EE_POSE, PREDICTIONS, *(topic("[^/]+") for topic in _OF_CAMERAS))
    )
)
