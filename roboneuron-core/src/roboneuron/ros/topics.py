"""Topic names of the contract, relative to the robot's namespace."""

ACTION = "action"
JOINT_STATES = "joint_states"
EE_POSE = "ee_pose"
PREDICTIONS = "predictions"
"""std_msgs/String: each prediction as a feature describes it
(`InferenceModule.describe_prediction`).
"""
JOINT_TRAJECTORY = "joint_trajectory"
JOINT_COMMAND = "joint_command"
DIAGNOSTICS = "/diagnostics"
WARM_UP = "_warm_up"
"""std_msgs/Empty, hidden as ROS hides names with an underscore: opens the ports of a module in
shadow.
"""


def camera_image(name: str) -> str:
    """Topic of a camera's images."""
    return f"camera/{name}/image"


def camera_info(name: str) -> str:
    """Topic of a camera's calibration, one message for each image."""
    return f"camera/{name}/camera_info"
