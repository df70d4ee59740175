"""The fixed image -> action contract: the only types that cross between models, perception, control
and robots.

numpy only. Nothing here knows ROS, MCP, torch or a plugin.
"""

from roboneuron.contract.action import (
    ACTION_SIZE,
    Action,
    ActionChunk,
    apply_delta,
    check_action_vector,
)
from roboneuron.contract.agreement import SpaceAgreement, agree
from roboneuron.contract.image import check_rgb8, frame_from_buffer
from roboneuron.contract.motion import Hold, JointCommand, Posture, Proximity, RobotState
from roboneuron.contract.observation import (
    Ahead,
    CameraCalibration,
    Frame,
    JointSample,
    Observation,
    Pose,
)
from roboneuron.contract.profile import (
    TOPIC_RULE,
    CameraProfile,
    CollisionProfile,
    Endpoint,
    GripperProfile,
    JointLimits,
    Obstacle,
    RobotProfile,
    Workspace,
    check_topic,
)
from roboneuron.contract.protocols import (
    Acceleration,
    AnyAcceleration,
    AnyRuntime,
    Backend,
    Controller,
    PerceptionSource,
    PostureInspector,
    RobotDriver,
    Runtime,
    SpaceController,
    Topics,
)
from roboneuron.contract.space import (
    ACTION_FIELDS,
    ACTION_LABEL,
    EE_DELTA,
    GRIPPER,
    SPACE_KINDS,
    Channel,
    ControlSpace,
    channel_keys,
    robot_space,
)

__all__ = [
    "ACTION_FIELDS",
    "ACTION_LABEL",
    "ACTION_SIZE",
    "EE_DELTA",
    "GRIPPER",
    "SPACE_KINDS",
    "TOPIC_RULE",
    "Acceleration",
    "Action",
    "ActionChunk",
    "Ahead",
    "AnyAcceleration",
    "AnyRuntime",
    "Backend",
    "CameraCalibration",
    "CameraProfile",
    "Channel",
    "CollisionProfile",
    "ControlSpace",
    "Controller",
    "Endpoint",
    "Frame",
    "GripperProfile",
    "Hold",
    "JointCommand",
    "JointLimits",
    "JointSample",
    "Observation",
    "Obstacle",
    "PerceptionSource",
    "Pose",
    "Posture",
    "PostureInspector",
    "Proximity",
    "RobotDriver",
    "RobotProfile",
    "RobotState",
    "Runtime",
    "SpaceAgreement",
    "SpaceController",
    "Topics",
    "Workspace",
    "agree",
    "apply_delta",
    "channel_keys",
    "check_action_vector",
    "check_rgb8",
    "check_topic",
    "frame_from_buffer",
    "robot_space",
]
