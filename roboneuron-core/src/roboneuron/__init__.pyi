"""The public API by defining module; read by `__init__.py` at run time, and by type checkers as a
stub.
"""

# ruff: noqa: I001
from . import (
    foreign as foreign,
)
from .compressed_image import (
    frame_from_compressed as frame_from_compressed,
)
from .config.models import (
    Section as Section,
)
from .contract import (
    ACTION_FIELDS as ACTION_FIELDS,
    ACTION_LABEL as ACTION_LABEL,
    ACTION_SIZE as ACTION_SIZE,
    Acceleration as Acceleration,
    Action as Action,
    ActionChunk as ActionChunk,
    Ahead as Ahead,
    AnyAcceleration as AnyAcceleration,
    AnyRuntime as AnyRuntime,
    ArmProfile as ArmProfile,
    ArmState as ArmState,
    Backend as Backend,
    CameraCalibration as CameraCalibration,
    CalibratedImage as CalibratedImage,
    CameraProfile as CameraProfile,
    CameraView as CameraView,
    LabelLocator as LabelLocator,
    LocatedObject as LocatedObject,
    Locator as Locator,
    Channel as Channel,
    CollisionProfile as CollisionProfile,
    ControlSpace as ControlSpace,
    Controller as Controller,
    EE_DELTA as EE_DELTA,
    Endpoint as Endpoint,
    MimicJoint as MimicJoint,
    Frame as Frame,
    GRIPPER as GRIPPER,
    GripperProfile as GripperProfile,
    Hold as Hold,
    LinkExtents as LinkExtents,
    JointCommand as JointCommand,
    JointKinds as JointKinds,
    JointLimits as JointLimits,
    JointSample as JointSample,
    LookaheadDriver as LookaheadDriver,
    Observation as Observation,
    Obstacle as Obstacle,
    PerceptionSource as PerceptionSource,
    Pose as Pose,
    Posture as Posture,
    PostureInspector as PostureInspector,
    Proximity as Proximity,
    RobotDriver as RobotDriver,
    RobotProfile as RobotProfile,
    RobotState as RobotState,
    Runtime as Runtime,
    SeveralArms as SeveralArms,
    SpaceController as SpaceController,
    Topics as Topics,
    Workspace as Workspace,
    apply_delta as apply_delta,
    channel_keys as channel_keys,
    depth_from_message as depth_from_message,
    image_from_message as image_from_message,
    joints_from_message as joints_from_message,
    mesh_file as mesh_file,
    pose_from_message as pose_from_message,
    robot_space as robot_space,
)
from .contract.arrays import (
    F64 as F64,
    freeze as freeze,
)
from .contract.image import (
    MAX_SIDE_PX as MAX_SIDE_PX,
)
from .contract.rotation import (
    matrix_from_quaternion as matrix_from_quaternion,
    matrix_from_rotvec as matrix_from_rotvec,
    quaternion_from_matrix as quaternion_from_matrix,
    rotvec_from_matrix as rotvec_from_matrix,
)
from .errors import (
    CheckpointError as CheckpointError,
    ConfigurationError as ConfigurationError,
    ForeignDataError as ForeignDataError,
    InternalError as InternalError,
    InvalidInputError as InvalidInputError,
    MissingDependencyError as MissingDependencyError,
    NotReadyError as NotReadyError,
    PlanningError as PlanningError,
    PluginError as PluginError,
    RefusedError as RefusedError,
    RoboNeuronError as RoboNeuronError,
    StateError as StateError,
    UngroundedError as UngroundedError,
    UnsafeError as UnsafeError,
    nearest as nearest,
)
from .plugins.availability import (
    install_command as install_command,
)
from .plugins.hookspecs import (
    hookimpl as hookimpl,
    hookspec as hookspec,
)
from .plugins.module_kind import (
    ModuleKindSpec as ModuleKindSpec,
)
from .plugins.option_marks import (
    AgentMaySet as AgentMaySet,
    ConfigurationOnly as ConfigurationOnly,
)
from .plugins.specs import (
    AccelerationSpec as AccelerationSpec,
    ActionSpace as ActionSpace,
    BackendSpec as BackendSpec,
    CONTRACT_VERSION as CONTRACT_VERSION,
    CameraSpec as CameraSpec,
    CommandSpec as CommandSpec,
    ControllerSpec as ControllerSpec,
    DriverSpec as DriverSpec,
    FeatureSpec as FeatureSpec,
    PICK_AND_PLACE as PICK_AND_PLACE,
    PerceptionSpec as PerceptionSpec,
    Requirement as Requirement,
    RobotSpec as RobotSpec,
    RuntimeSpec as RuntimeSpec,
    Spec as Spec,
    LocatorSpec as LocatorSpec,
    Verb as Verb,
)
from .sight.boxes import (
    ImageDetection as ImageDetection,
    place_detections as place_detections,
)
from .server.feature import (
    Feature as Feature,
)
from .server.host import (
    Host as Host,
)
from .server.tool import (
    Arguments as Arguments,
    CallContext as CallContext,
    NoArguments as NoArguments,
    Picture as Picture,
    Reply as Reply,
    Resource as Resource,
    Result as Result,
    Tool as Tool,
    Transport as Transport,
)

__version__: str
__all__: list[str]
