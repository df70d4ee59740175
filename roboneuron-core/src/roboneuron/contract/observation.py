"""Input of a backend: images, the instruction, proprioception, each with its own time, and the
actions already planned.

Arrays are kept as read-only copies. An image is too large for a copy at every step: a frame keeps a
read-only view of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.arrays import F64, ReadOnly, freeze, read_only_view
from roboneuron.contract.image import check_rgb8
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CameraCalibration(ReadOnly):
    """A pinhole camera and its mounting.

    Attributes:
        intrinsics: float64 (3, 3) in pixels; u to the right, v down, pixel centres at integers +
            0.5.
        mount: "base" (fixed beside the robot), "tcp" (carried by the end effector; of several arms
            the first one's), or "<arm>/tcp" of another arm.
        T_mount_camera: float64 (4, 4), pose of the optical frame in the mount frame [m]; the
            optical frame looks along +z with x right and y down (REP 103).
    """

    intrinsics: F64
    mount: str
    T_mount_camera: F64

    @property
    def arm(self) -> str | None:
        """The arm that carries it, "" for the first or only one; None for a fixed camera."""
        return None if self.mount == "base" else self.mount.removesuffix("tcp").removesuffix("/")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Frame:
    """One camera image.

    Attributes:
        camera: the camera's name on the robot ("front", "wrist").
        image: uint8 (H, W, 3), RGB, row 0 on top; a read-only view; its source must not modify the
            memory.
        stamp_ns: capture time, ROS clock [ns].
        frame_id: optical frame's name, never empty.
        calibration: None when the robot's profile has none for this camera.
        depth_m: float32 (H, W), distance along the optical axis registered to the image [m], NaN
            where unknown; read-only like it. None without a depth camera, and for policies.

    Raises:
        InvalidInputError: the image is not uint8 (H, W, 3), or the depth has another size.
    """

    camera: str
    image: NDArray[np.uint8]
    stamp_ns: int
    frame_id: str
    calibration: CameraCalibration | None = None
    depth_m: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", read_only_view(check_rgb8(self.image)))
        if self.depth_m is None:
            return
        if self.depth_m.shape != self.image.shape[:2] or self.depth_m.dtype != np.float32:
            raise InvalidInputError(
                f"The depth of camera {self.camera!r} is {self.depth_m.dtype} "
                f"{self.depth_m.shape}, expected float32 {self.image.shape[:2]} like its picture."
            )
        object.__setattr__(self, "depth_m", read_only_view(self.depth_m))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Pose(ReadOnly):
    """A TCP pose in the robot's base frame.

    Attributes:
        position_m: float64 (3,).
        quaternion_xyzw: float64 (4,), unit length.
        stamp_ns: measurement time, ROS clock [ns].
    """

    position_m: F64
    quaternion_xyzw: F64
    stamp_ns: int = 0

    @property
    def matrix(self) -> F64:
        """The transform from the TCP to the base frame, float64 (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = matrix_from_quaternion(self.quaternion_xyzw)
        matrix[:3, 3] = self.position_m
        return matrix


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class JointSample(ReadOnly):
    """Measured joints, by name.

    Attributes:
        names: joint names, in the order of the arrays.
        position: float64 (n,), rad (revolute) or m (prismatic).
        velocity: float64 (n,), rad/s or m/s; None when not measured.
        stamp_ns: measurement time, ROS clock [ns].
    """

    names: tuple[str, ...]
    position: F64
    velocity: F64 | None = None
    stamp_ns: int = 0

    def get(self, name: str) -> float | None:
        """Position of a joint [rad or m]; None if it is not among these."""
        return float(self.position[self.names.index(name)]) if name in self.names else None


def joints_from_message(message: Any) -> JointSample:
    """sensor_msgs/JointState -> JointSample. A velocity that is not a number is none: the
    joint_state_broadcaster of ros2_control fills them in for joints without a velocity interface.

    Raises:
        InvalidInputError: names and positions differ in number, a name occurs twice, or velocities
            differ in number.
    """
    names = tuple(message.name)
    if len(names) != len(message.position) or len(set(names)) != len(names):
        raise InvalidInputError(
            f"A joint state has {len(names)} names ({len(set(names))} different) and "
            f"{len(message.position)} positions."
        )
    velocity = np.array(message.velocity, dtype=np.float64) if len(message.velocity) else None
    if velocity is not None and len(velocity) != len(names):
        raise InvalidInputError(
            f"A joint state has {len(names)} names and {len(velocity)} velocities."
        )
    if velocity is not None and np.isnan(velocity).all():
        velocity = None
    return JointSample(
        names=names,
        position=np.array(message.position, dtype=np.float64),
        velocity=velocity,
        stamp_ns=to_ns(message.header.stamp),
    )


def pose_from_message(message: Any) -> Pose:
    """geometry_msgs/PoseStamped -> Pose in the message's frame, which is not checked: that of
    `ee_pose` is the robot's base.

    Raises:
        InvalidInputError: a value is not finite.
    """
    p, q = message.pose.position, message.pose.orientation
    if not all(map(math.isfinite, (p.x, p.y, p.z, q.x, q.y, q.z, q.w))):
        raise InvalidInputError("A pose holds a value that is not finite.")
    return Pose(
        position_m=np.array([p.x, p.y, p.z]),
        quaternion_xyzw=np.array([q.x, q.y, q.z, q.w]),
        stamp_ns=to_ns(message.header.stamp),
    )


def to_ns(stamp: Any) -> int:
    """builtin_interfaces/Time -> nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ArmState:
    """Measured state of one of several arms.

    Attributes:
        ee_pose: pose of its TCP in the base frame.
        gripper_open: 0 closed .. 1 open; None without a gripper.
    """

    ee_pose: Pose
    gripper_open: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Ahead:
    """Actions from the capture of an observation until the end of the present plan. A read-only
    copy.

    Row 0 is the first one sent after the capture, at the time of row 0 of the new chunk. Some rows
    may already have been sent when the backend gets them.

    Attributes:
        rows: float64 (N, n), N >= 0, contract units, oldest first, in the space that control gets
            (n = 7 in the default space).
        committed_rows: number of rows that will be executed whatever the backend answers, 0 .. N.
        step_s: their period [s], > 0.
        context: `ActionChunk.context` of the running chunk; None if it had none, or if rows of
            another instruction lie between.
        context_row: index of `rows[0]` in the running chunk.
        state_ahead_s: `ee_pose` and `gripper_open` of the observation are predicted for this long
            after the capture [s]; 0 when they are measured.

    Raises:
        InvalidInputError: a shape or number is out of range.
    """

    rows: F64
    committed_rows: int
    step_s: float
    context: Any = None
    context_row: int = 0
    state_ahead_s: float = 0.0

    def __post_init__(self) -> None:
        rows = np.asarray(self.rows, dtype=np.float64)
        if rows.ndim != 2 or not np.isfinite(rows).all():
            raise InvalidInputError(
                f"Rows ahead have shape {rows.shape}, expected finite numbers (N, n)."
            )
        if not 0 <= self.committed_rows <= len(rows) or self.context_row < 0:
            raise InvalidInputError(
                f"committed_rows is {self.committed_rows} of {len(rows)} rows, context_row "
                f"{self.context_row}."
            )
        if not self.step_s > 0 or self.state_ahead_s < 0:
            raise InvalidInputError(
                f"step_s is {self.step_s}, state_ahead_s {self.state_ahead_s}: no times ahead."
            )
        freeze(self, "rows")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Observation:
    """All inputs of one prediction.

    Attributes:
        frames: newest frame by *role* ("primary", "wrist"), exactly the roles that the backend's
            descriptor names.
        instruction: the agent's instruction; never empty.
        joints: measured joints, or None when the backend's descriptor does not ask for state.
        ee_pose: measured TCP pose in the base frame, or None for the same reason.
        gripper_open: measured opening, 0 closed .. 1 open, or None for the same reason.
        arms: state of each arm by name, on a robot with several; the two fields above are those of
            the first. Empty for one arm, and for a backend that does not ask for state.
        stamp_ns: capture time of the oldest frame, ROS clock [ns].
        ahead: planned actions, for backends that declare `conditions_on_rows` or
            `takes_predicted_state`; None for others, and when nothing is planned.
    """

    frames: Mapping[str, Frame]
    instruction: str
    joints: JointSample | None = None
    ee_pose: Pose | None = None
    gripper_open: float | None = None
    stamp_ns: int = 0
    ahead: Ahead | None = None
    arms: Mapping[str, ArmState] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", dict(self.frames))
        object.__setattr__(self, "arms", dict(self.arms))
