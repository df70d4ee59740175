"""Topic names of the contract, relative to the robot's namespace."""

ACTION = "action"
JOINT_STATES = "joint_states"
EE_POSE = "ee_pose"
JOINT_TRAJECTORY = "joint_trajectory"
JOINT_COMMAND = "joint_command"
DIAGNOSTICS = "/diagnostics"
WARM_UP = "warm_up"
"""std_msgs/Empty under the robot's namespace: says nothing; opens the ways of a module that is about to take over."""


def camera_image(name: str) -> str:
    """Topic of a camera's images."""
    return f"camera/{name}/image"


def camera_info(name: str) -> str:
    """Topic of a camera's calibration, one message for each image."""
    return f"camera/{name}/camera_info"
