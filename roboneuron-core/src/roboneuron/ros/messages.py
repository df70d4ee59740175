"""Conversions between ROS messages and contract types. Every value is coerced: rclpy sends an int
in a float64 field as garbage.
"""

from __future__ import annotations

import array
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron.contract import (
    ACTION_LABEL,
    EE_DELTA,
    F64,
    GREATEST_RATE_HZ,
    STATE_STEP_S,
    CameraCalibration,
    ControlSpace,
    Frame,
    JointCommand,
    JointSample,
    Pose,
    image_from_message,
    joints_from_message,
)
from roboneuron.contract.observation import NS_PER_S, to_ns
from roboneuron.errors import InvalidInputError

_PLANNED = "planned@"
_MOST_PLANNED = 50
"""Number of planned rows that are read: each is computed again with every incoming row."""
_HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlannedRows:
    """Rows that a policy plans after the current one.

    Attributes:
        rows: float64 (k, n), in the space of the current row.
        step_s: time between two rows [s], > 0.
    """

    rows: F64
    step_s: float

    @classmethod
    def from_action_message(cls, message: Float64MultiArray) -> Self | None:
        """Read the first planned rows of a message, unchecked; None without any.

        Raises:
            InvalidInputError: the second dimension is not one of planned rows, or its size does not
                match its values.
        """
        dims = message.layout.dim
        if len(dims) < 2:
            return None
        width, count, label = dims[0].size, dims[1].size, dims[1].label
        try:
            rate_hz = float(label.removeprefix(_PLANNED)) if label.startswith(_PLANNED) else 0.0
        except ValueError:
            rate_hz = 0.0
        is_whole = width > 0 and len(message.data) == width * (count + 1)
        if len(dims) > 2 or not (0.0 < rate_hz <= GREATEST_RATE_HZ) or not is_whole:
            raise InvalidInputError(
                f"An action has {len(message.data)} values, and its second dimension is {label!r} "
                f"of {count}; expected '{_PLANNED}<rows per second>' and rows of {width} values."
            )
        rows = np.array(message.data[width:], dtype=np.float64).reshape(count, width)
        return cls(rows=rows[:_MOST_PLANNED], step_s=1.0 / rate_hz)


def to_time(stamp_ns: int) -> Time:
    """Nanoseconds -> builtin_interfaces/Time."""
    return Time(sec=int(stamp_ns // NS_PER_S), nanosec=int(stamp_ns % NS_PER_S))


def to_image(frame: Frame) -> Image:
    """Frame -> sensor_msgs/Image, rgb8. One copy of the pixels (0.1 ms at 640x480)."""
    return _image(frame, frame.image, "rgb8")


def frame_from_message(
    message: Image, camera: str, calibration: CameraCalibration | None = None
) -> Frame:
    """sensor_msgs/Image -> Frame; `rgb8` shares the message's memory.

    Args:
        camera: the camera's name.
        calibration: of this camera at this image size.

    Raises:
        InvalidInputError: unknown encoding, damaged sizes, or an unset stamp.
    """
    stamp_ns = to_ns(message.header.stamp)
    if stamp_ns <= 0:
        raise InvalidInputError(
            f"An image of camera {camera!r} carries no capture time in header.stamp."
        )
    return Frame(
        camera=camera,
        image=image_from_message(message),
        stamp_ns=stamp_ns,
        frame_id=message.header.frame_id or camera,
        calibration=calibration,
    )


def to_depth_image(frame: Frame, depth_m: NDArray[np.float32]) -> Image:
    """Depth of a frame -> sensor_msgs/Image, 32FC1 [m], with the stamp of the image."""
    return _image(frame, depth_m.astype("<f4", copy=False), "32FC1")


def _image(frame: Frame, pixels: NDArray[Any], encoding: str) -> Image:
    height, width = pixels.shape[:2]
    step = pixels.nbytes // height
    message = Image(height=height, width=width, encoding=encoding, is_bigendian=0, step=step)
    message.header.stamp = to_time(frame.stamp_ns)
    message.header.frame_id = frame.frame_id
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(pixels).data.cast("B"))
    message.data = data
    return message


def intrinsics_from_camera_info(message: CameraInfo) -> F64:
    """sensor_msgs/CameraInfo -> float64 (3, 3) [px] in the contract's convention (see
    `CameraCalibration`).

    Source of the half pixel: image_geometry and OpenCV put pixel centres at integers, the contract
    at integers + 0.5.

    Raises:
        InvalidInputError: the camera was never calibrated (focal length 0), or a value is not
            finite.
    """
    intrinsics = np.array(message.k, dtype=np.float64).reshape(3, 3)
    if not np.isfinite(intrinsics).all() or intrinsics[0, 0] <= 0 or intrinsics[1, 1] <= 0:
        raise InvalidInputError(
            f"The camera_info of {message.header.frame_id!r} holds no calibration: k is "
            f"{intrinsics.ravel().tolist()}."
        )
    calibrated: F64 = intrinsics + _HALF_PIXEL
    return calibrated


def to_action_message(
    row: F64, space: ControlSpace = EE_DELTA, planned: PlannedRows | None = None
) -> Float64MultiArray:
    """One row (n,) of a space -> std_msgs/Float64MultiArray with the label of the space.

    Planned rows follow in a second dimension, "planned@<rows per second>". The message has no
    stamp: control uses the source time stamp of DDS.
    """
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label=space.label, size=space.size, stride=space.size)
    ]
    message.data = array.array("d", row.tolist())
    if planned is not None and len(planned.rows):
        label = f"{_PLANNED}{1.0 / planned.step_s:g}"
        count = len(planned.rows)
        message.layout.dim.append(
            MultiArrayDimension(label=label, size=count, stride=count * space.size)
        )
        message.data.extend(planned.rows.ravel().tolist())
    return message


def row_from_action_message(message: Float64MultiArray) -> tuple[str, F64]:
    """std_msgs/Float64MultiArray -> label of the space and float64 (n,), both unchecked.

    A message without a layout counts as the contract's 7-vector. Planned rows are left out.
    """
    dims = message.layout.dim
    label = dims[0].label if dims else ACTION_LABEL
    values = message.data[: dims[0].size] if len(dims) > 1 else message.data
    return label, np.array(values, dtype=np.float64)


def to_joint_state(joints: JointSample) -> JointState:
    """JointSample -> sensor_msgs/JointState."""
    message = JointState(name=list(joints.names))
    message.header.stamp = to_time(joints.stamp_ns)
    message.position = array.array("d", joints.position.tolist())
    if joints.velocity is not None:
        message.velocity = array.array("d", joints.velocity.tolist())
    return message


def to_pose_stamped(pose: Pose, frame_id: str) -> PoseStamped:
    """Pose -> geometry_msgs/PoseStamped in `frame_id`."""
    message = PoseStamped()
    message.header.stamp = to_time(pose.stamp_ns)
    message.header.frame_id = frame_id
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = (float(v) for v in pose.position_m)
    orientation.x, orientation.y, orientation.z, orientation.w = (
        float(v) for v in pose.quaternion_xyzw
    )
    return message


def to_joint_trajectory(*commands: JointCommand) -> JointTrajectory:
    """Commands for the same joints, in sequence -> trajectory_msgs/JointTrajectory with one point
    each, to start at once.

    The stamp stays 0, which by the definition of the message means "now", independent of the clock
    of the robot's machine.
    """
    points: list[JointTrajectoryPoint] = []
    elapsed_s = 0.0
    for command in commands:
        elapsed_s += command.duration_s
        seconds = int(elapsed_s)
        # rounding may result in a whole second, which the field must not contain
        nanoseconds = round((elapsed_s - seconds) * NS_PER_S)
        point = JointTrajectoryPoint(
            time_from_start=Duration(sec=seconds, nanosec=min(nanoseconds, NS_PER_S - 1))
        )
        point.positions = array.array("d", command.position.tolist())
        points.append(point)
    return JointTrajectory(joint_names=list(commands[0].names), points=points)


def commands_from_message(message: JointTrajectory | JointState) -> list[JointCommand]:
    """One command per point of a trajectory; `duration_s` is the time since the previous point.

    Positions without times (a JointState) are one command, to be reached in 0.1 s.

    Raises:
        InvalidInputError: no points, sizes that do not match, non-finite positions, or times that
            do not increase.
    """
    if isinstance(message, JointState):
        joints = joints_from_message(message)
        return [JointCommand(names=joints.names, position=joints.position, duration_s=STATE_STEP_S)]
    names = tuple(message.joint_names)
    if not message.points or not names:
        raise InvalidInputError("A joint trajectory has no points or no joint names.")
    commands: list[JointCommand] = []
    elapsed_s = 0.0
    for index, point in enumerate(message.points):
        time_s = point.time_from_start.sec + point.time_from_start.nanosec / NS_PER_S
        position = np.array(point.positions, dtype=np.float64)
        if position.shape != (len(names),):
            raise InvalidInputError(
                f"Point {index} has {position.size} positions for {len(names)} joints."
            )
        if not np.isfinite(position).all():
            raise InvalidInputError(f"Point {index} holds a non-finite position.")
        if time_s <= elapsed_s:
            raise InvalidInputError(
                f"time_from_start of point {index} is {time_s:g} s, not after {elapsed_s:g} s."
            )
        commands.append(JointCommand(names=names, position=position, duration_s=time_s - elapsed_s))
        elapsed_s = time_s
    return commands
