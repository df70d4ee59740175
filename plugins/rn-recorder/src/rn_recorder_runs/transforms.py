"""Transforms and robot description for a recording: from the robot's URDF, its cameras and its
joint states.

RoboNeuron's own processes publish none, but a file has to show the robot in any viewer. It is
independent of ROS. Source: REP 105 and the URDF specification (a joint's origin is rpy about fixed
axes; a joint's axis defaults to x).
"""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs.files import Record
from rn_recorder_runs.images import to_string
from rn_recorder_runs.settings import CameraMount
from roboneuron import ConfigurationError, JointKinds, quaternion_from_matrix

F64 = NDArray[np.float64]
TF, TF_STATIC, DESCRIPTION = "/tf", "/tf_static", "robot_description"
TF_TYPE, STRING = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"
_HEADER = b"\x00\x01\x00\x00"
_MOVING = frozenset({"revolute", "continuous", "prismatic"})


@dataclass(frozen=True, slots=True)
class FramePose:
    """Pose of frame `child` in frame `parent`: position [m], quaternion x y z w."""

    parent: str
    child: str
    position_m: F64
    quaternion_xyzw: F64


@dataclass(frozen=True, slots=True)
class _Joint:
    name: str
    parent: str
    child: str
    kind: str
    position_m: F64
    rotation: F64
    axis: F64

    def at(self, position: float) -> FramePose:
        """The transform with the joint at that position [rad or m]."""
        place, rotation = self.position_m, self.rotation
        if self.kind == "prismatic":
            place = place + rotation @ (self.axis * position)
        elif self.kind in _MOVING:
            rotation = rotation @ _turn(self.axis, position)
        return FramePose(self.parent, self.child, place, quaternion_from_matrix(rotation))


class RobotTransforms:
    """The frames of one robot.

    Args:
        urdf: XML text; empty for a robot without kinematics: cameras alone then.
        cameras: those whose mount is known.
    """

    def __init__(self, urdf: str, cameras: Sequence[CameraMount] = ()) -> None:
        self.urdf = urdf
        joints = _joints(urdf) if urdf else []
        self._moving = [joint for joint in joints if joint.kind in _MOVING]
        kinds = JointKinds.of(urdf)
        try:
            self._configuration = kinds.configuration([joint.name for joint in self._moving])
        except ConfigurationError as error:
            raise ValueError(f"the robot description cannot be read: {error}") from error
        self._leaders = {follower.name: follower.leader for follower in kinds.followers}
        self._fixed = [joint.at(0.0) for joint in joints if joint.kind not in _MOVING]
        self._fixed += [
            FramePose(
                mount.parent,
                mount.frame_id,
                np.array(mount.position_m),
                np.array(mount.quaternion_xyzw),
            )
            for mount in cameras
        ]

    @property
    def has_fixed(self) -> bool:
        """True if there are static frames."""
        return bool(self._fixed)

    def static(self, at_ns: int) -> Record:
        """The message for /tf_static."""
        return Record(TF_STATIC, TF_TYPE, at_ns, at_ns, 0, to_tf_message(self._fixed, at_ns))

    def description(self, topic: str, at_ns: int) -> Record:
        """The message for `robot_description`."""
        return Record(topic, STRING, at_ns, at_ns, 0, to_string(self.urdf))

    def moving(
        self, names: Sequence[str], positions: Sequence[float], stamp_ns: int, at_ns: int
    ) -> Record | None:
        """The message for /tf from joint states; None if they name none of the robot's joints."""
        found = self._at(dict(zip(names, positions, strict=False)))
        return (
            Record(TF, TF_TYPE, at_ns, at_ns, 0, to_tf_message(found, stamp_ns)) if found else None
        )

    def poses(self, joints: Mapping[str, float]) -> list[FramePose]:
        """The static frames and those of joints at these positions by name [rad or m]."""
        return [*self._fixed, *self._at(joints)]

    def _at(self, joints: Mapping[str, float]) -> list[FramePose]:
        positions = self._configuration.of(joints).tolist()
        return [
            joint.at(position)
            for joint, position in zip(self._moving, positions, strict=True)
            if joint.name in joints or self._leaders.get(joint.name) in joints
        ]


def to_tf_message(transforms: Sequence[FramePose], stamp_ns: int) -> bytes:
    """A CDR `tf2_msgs/TFMessage`."""
    body = struct.pack("<I", len(transforms))
    for transform in transforms:
        body += b"\0" * (-len(body) % 4) + struct.pack("<iI", *divmod(stamp_ns, 1_000_000_000))
        for text in (transform.parent, transform.child):
            data = text.encode() + b"\0"
            body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(data)) + data
        values = (*transform.position_m.tolist(), *transform.quaternion_xyzw.tolist())
        body += b"\0" * (-len(body) % 8) + struct.pack("<7d", *values)
    return _HEADER + body


def _joints(urdf: str) -> list[_Joint]:
    """Every joint of a URDF. Raises ValueError if it cannot be read."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ValueError(f"the robot description is no XML: {error}") from error
    found = []
    for joint in root.findall("joint"):
        parent, child, origin, axis = (
            joint.find(word) for word in ("parent", "child", "origin", "axis")
        )
        if parent is None or child is None:
            continue
        direction = _numbers(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0))
        found.append(
            _Joint(
                name=joint.get("name", ""),
                parent=parent.get("link", ""),
                child=child.get("link", ""),
                kind=joint.get("type", "fixed"),
                position_m=_numbers(None if origin is None else origin.get("xyz"), (0.0, 0.0, 0.0)),
                rotation=_from_rpy(
                    _numbers(None if origin is None else origin.get("rpy"), (0.0, 0.0, 0.0))
                ),
                axis=direction / max(float(np.linalg.norm(direction)), 1e-12),
            )
        )
    return found


def _numbers(text: str | None, default: tuple[float, float, float]) -> F64:
    return np.array(
        default if text is None else [float(word) for word in text.split()], dtype=np.float64
    )


def _from_rpy(rpy: F64) -> F64:
    x, y, z = np.eye(3)
    return _turn(z, rpy[2]) @ _turn(y, rpy[1]) @ _turn(x, rpy[0])


def _turn(axis: F64, angle: float) -> F64:
    """Rotation matrix. Source: Rodrigues."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: F64 = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return matrix
