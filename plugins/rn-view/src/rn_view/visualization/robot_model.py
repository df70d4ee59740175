"""Kinematics and shapes of a robot, from its URDF."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from roboneuron import RobotProfile

if TYPE_CHECKING:
    import yourdfpy

F64 = NDArray[np.float64]


class RobotModel:
    """A robot's kinematics and shapes from its URDF.

    Raises:
        ValueError: yourdfpy cannot read the URDF.
    """

    def __init__(self, profile: RobotProfile) -> None:
        import yourdfpy  # heavy

        self.profile = profile
        self.urdf: yourdfpy.URDF = yourdfpy.URDF.load(io.BytesIO(_one_number_each(profile)))
        self._configuration = profile.kinds.configuration(self.urdf.actuated_joint_names)

    def configuration(self, joints: Mapping[str, float]) -> F64:
        """Joint positions in the order of the URDF, as `JointConfiguration` has them."""
        return self._configuration.of(joints)

    def tcps_of(self, joints: Mapping[str, float]) -> dict[str, F64]:
        """TCP pose (4, 4) of each arm in the base frame. Leaves the model at these joint
        positions.
        """
        self.urdf.update_cfg(self.configuration(joints))
        base = self.profile.base_link
        return {
            arm.name: np.asarray(self.urdf.get_transform(arm.tcp_link, base), dtype=np.float64)
            for arm in self.profile.each_arm
        }

    def joint_place(self, joint: str, joints: Mapping[str, float]) -> F64 | None:
        """Position [m] of a joint in the base frame; None if the URDF has no such joint. Leaves the
        model at these joint positions.
        """
        found = self.urdf.joint_map.get(joint)
        if found is None:
            return None
        self.urdf.update_cfg(self.configuration(joints))
        pose = self.urdf.get_transform(found.child, self.profile.base_link)
        return np.asarray(pose, dtype=np.float64)[:3, 3]


def _one_number_each(profile: RobotProfile) -> bytes:
    """The description with followers that are set as others are, by `JointConfiguration`, and with
    axes of unit length: yourdfpy knows no follower of a follower, and slides by the axis as it is.
    Joints that no number describes are fixed.
    """
    try:
        robot = ET.fromstring(profile.urdf)
    except ET.ParseError as error:
        raise ValueError(f"The robot description is no XML: {error}") from error
    for joint in robot.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
        axis = joint.find("axis")
        if axis is not None:
            direction = np.array([float(word) for word in axis.get("xyz", "1 0 0").split()])
            direction /= float(np.linalg.norm(direction)) or 1.0
            axis.set("xyz", " ".join(map(repr, direction.tolist())))
        if joint.get("name") not in profile.kinds.moving:
            joint.set("type", "fixed")
    return ET.tostring(robot)
