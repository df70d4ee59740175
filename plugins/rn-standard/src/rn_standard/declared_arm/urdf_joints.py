"""The joints of a robot description, read from its XML."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np

from roboneuron import F64, matrix_from_rotvec

MOVABLE = ("revolute", "continuous", "prismatic")
"""Types of joints with one position."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        name, kind: as in the URDF ("revolute", "fixed" ...).
        child: the link it carries.
        origin: float64 (4, 4), pose of the joint in its parent link.
        axis: float64 (3,), unit length.
        lower, upper, velocity: limits [rad or m, per second]; infinite if the URDF has none.
    """

    name: str
    kind: str
    child: str
    origin: F64
    axis: F64
    lower: float
    upper: float
    velocity: float

    def transform(self, position: float) -> F64:
        """Pose of the child link in the parent link, float64 (4, 4)."""
        motion = np.eye(4)
        if self.kind == "prismatic":
            motion[:3, 3] = self.axis * position
        elif self.kind in MOVABLE:
            motion[:3, :3] = matrix_from_rotvec(self.axis * position)
        return self.origin @ motion


def read_joints(urdf: str) -> dict[str, tuple[str, UrdfJoint]]:
    """Parent link and joint by child link. Raises ValueError for an invalid URDF."""
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ValueError(f"the URDF is not valid XML: {error}") from error
    joints: dict[str, tuple[str, UrdfJoint]] = {}
    for element in root.findall("joint"):
        joint = _read_joint(element)
        joints[joint.child] = (_attribute(element, "parent", "link", ""), joint)
    return joints


def _read_joint(element: ElementTree.Element) -> UrdfJoint:
    roll, pitch, yaw = _numbers(_attribute(element, "origin", "rpy", "0 0 0"))
    origin = np.eye(4)
    x, y, z = np.eye(3)
    origin[:3, :3] = (
        matrix_from_rotvec(z * yaw) @ matrix_from_rotvec(y * pitch) @ matrix_from_rotvec(x * roll)
    )
    origin[:3, 3] = _numbers(_attribute(element, "origin", "xyz", "0 0 0"))
    axis = _numbers(_attribute(element, "axis", "xyz", "1 0 0"))
    return UrdfJoint(
        name=element.get("name", ""),
        kind=element.get("type", ""),
        child=_attribute(element, "child", "link", ""),
        origin=origin,
        axis=axis / (np.linalg.norm(axis) or 1.0),
        lower=float(_attribute(element, "limit", "lower", "-inf")),
        upper=float(_attribute(element, "limit", "upper", "inf")),
        velocity=float(_attribute(element, "limit", "velocity", "inf")),
    )


def _attribute(element: ElementTree.Element, child: str, name: str, default: str) -> str:
    found = element.find(child)
    return default if found is None else found.get(name, default)


def _numbers(text: str) -> F64:
    return np.array([float(word) for word in text.split()])
