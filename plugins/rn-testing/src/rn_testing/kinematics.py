"""Forward kinematics from the URDF alone, independent of the controllers that it checks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rn_standard.declared_arm import urdf_joints
from rn_standard.declared_arm.urdf_joints import UrdfJoint
from rn_testing.rule import Violation
from roboneuron import Pose, RobotProfile, quaternion_from_matrix


def read_joints(urdf: str) -> dict[str, tuple[str, UrdfJoint]]:
    """Parent link and joint by child link. Raises Violation for an invalid URDF."""
    try:
        return urdf_joints.read_joints(urdf)
    except ValueError as error:
        raise Violation(str(error)) from error


def read_chain(profile: RobotProfile) -> tuple[UrdfJoint, ...]:
    """The joints from base to TCP. Raises Violation if the URDF does not connect them."""
    joints = read_joints(profile.urdf)
    chain: list[UrdfJoint] = []
    link = profile.tcp_link
    while link != profile.base_link and link in joints and len(chain) <= len(joints):
        link, joint = joints[link]
        chain.insert(0, joint)
    if link != profile.base_link:
        raise Violation(f"the URDF has no chain from {profile.base_link!r} to {profile.tcp_link!r}")
    return tuple(chain)


def place_tcp(profile: RobotProfile, positions: Mapping[str, float]) -> Pose:
    """Pose of the TCP in the base frame; joints without a position are at rest."""
    configuration = profile.kinds.configuration()
    placed = dict(zip(configuration.order, configuration.of(positions).tolist(), strict=True))
    pose = np.eye(4)
    for joint in read_chain(profile):
        pose = pose @ joint.transform(placed.get(joint.name, 0.0))
    return Pose(position_m=pose[:3, 3], quaternion_xyzw=quaternion_from_matrix(pose[:3, :3]))
