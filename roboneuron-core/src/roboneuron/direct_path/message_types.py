"""Protocols of ROS messages: each is the part of a message that limits are about. Message classes
are created at run time from their definitions, so they have no static types.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

MessageT_co = TypeVar("MessageT_co", covariant=True)


class MessageName(str, Generic[MessageT_co]):
    """Name of a message type, such as "geometry_msgs/msg/PoseStamped", with its protocol."""


class RosMessage(Protocol):
    """Any message, goal, request or response."""

    def __init__(self, **fields: object) -> None: ...

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Fields by name, with their types in rosidl notation."""
        ...


class Stamp(Protocol):
    """builtin_interfaces/Time and Duration."""

    sec: int
    nanosec: int


class MessageHeader(Protocol):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Vector(Protocol):
    """geometry_msgs/Point and Vector3."""

    x: float
    y: float
    z: float


class Quaternion(Protocol):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class PoseMessage(Protocol):
    """geometry_msgs/Pose."""

    position: Vector
    orientation: Quaternion


class PoseStamped(Protocol):
    """geometry_msgs/PoseStamped."""

    header: MessageHeader
    pose: PoseMessage


class PointStamped(Protocol):
    """geometry_msgs/PointStamped."""

    header: MessageHeader
    point: Vector


class TransformParts(Protocol):
    """geometry_msgs/Transform."""

    translation: Vector
    rotation: Quaternion


class TransformStamped(Protocol):
    """geometry_msgs/TransformStamped."""

    header: MessageHeader
    child_frame_id: str
    transform: TransformParts


class TransformMessage(Protocol):
    """tf2_msgs/TFMessage."""

    transforms: Sequence[TransformStamped]


class TrajectoryPoint(Protocol):
    """trajectory_msgs/JointTrajectoryPoint."""

    positions: Sequence[float]
    velocities: Sequence[float]
    accelerations: Sequence[float]
    effort: Sequence[float]
    time_from_start: Stamp


class JointTrajectory(Protocol):
    """trajectory_msgs/JointTrajectory."""

    joint_names: Sequence[str]
    points: Sequence[TrajectoryPoint]


class JointState(Protocol):
    """sensor_msgs/JointState."""

    name: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float]
    effort: Sequence[float]
