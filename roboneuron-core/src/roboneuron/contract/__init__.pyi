"""The names of the contract by the modules that define them; `__init__.py` reads this at run time,
type checkers as a stub.
"""

# ruff: noqa: I001
from .action import (
    ACTION_SIZE as ACTION_SIZE,
    Action as Action,
    ActionChunk as ActionChunk,
    apply_delta as apply_delta,
)
from .arrays import (
    F64 as F64,
)
from .image import (
    check_rgb8 as check_rgb8,
    depth_from_message as depth_from_message,
    frame_from_buffer as frame_from_buffer,
    image_from_message as image_from_message,
)
from .joints import (
    MimicJoint as MimicJoint,
    JointKinds as JointKinds,
    JointSpan as JointSpan,
    TURN as TURN,
    nearest_turn as nearest_turn,
    urdf_joints as urdf_joints,
)
from .meshes import (
    collision_meshes as collision_meshes,
    mesh_file as mesh_file,
)
from .camera_view import (
    CameraView as CameraView,
)
from .locator import (
    CalibratedImage as CalibratedImage,
    LabelLocator as LabelLocator,
    LocatedObject as LocatedObject,
    Locator as Locator,
)
from .motion import (
    STATE_STEP_S as STATE_STEP_S,
    Hold as Hold,
    LinkExtents as LinkExtents,
    JointCommand as JointCommand,
    Posture as Posture,
    Proximity as Proximity,
    RobotState as RobotState,
)
from .observation import (
    Ahead as Ahead,
    ArmState as ArmState,
    CameraCalibration as CameraCalibration,
    Frame as Frame,
    JointSample as JointSample,
    Observation as Observation,
    Pose as Pose,
    joints_from_message as joints_from_message,
    pose_from_message as pose_from_message,
    to_ns as to_ns,
)
from .profile import (
    TOPIC_RULE as TOPIC_RULE,
    ArmProfile as ArmProfile,
    CameraProfile as CameraProfile,
    CollisionProfile as CollisionProfile,
    Endpoint as Endpoint,
    GripperProfile as GripperProfile,
    JointLimits as JointLimits,
    Obstacle as Obstacle,
    RobotProfile as RobotProfile,
    Workspace as Workspace,
    check_topic as check_topic,
)
from .protocols import (
    Acceleration as Acceleration,
    AnyAcceleration as AnyAcceleration,
    AnyRuntime as AnyRuntime,
    Backend as Backend,
    Controller as Controller,
    LookaheadDriver as LookaheadDriver,
    PerceptionSource as PerceptionSource,
    PostureInspector as PostureInspector,
    RobotDriver as RobotDriver,
    Runtime as Runtime,
    SeveralArms as SeveralArms,
    SpaceController as SpaceController,
    Topics as Topics,
)
from .space import (
    ACTION_FIELDS as ACTION_FIELDS,
    ACTION_LABEL as ACTION_LABEL,
    EE_DELTA as EE_DELTA,
    GREATEST_RATE_HZ as GREATEST_RATE_HZ,
    GRIPPER as GRIPPER,
    SPACE_KINDS as SPACE_KINDS,
    Channel as Channel,
    ControlSpace as ControlSpace,
    channel_keys as channel_keys,
    robot_space as robot_space,
)
