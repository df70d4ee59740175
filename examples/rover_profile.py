"""Profile of a rover: a base that drives and turns, a lift, one joint and a gripper. Their
velocities are channels of one control space: docs/action-spaces.md.
"""

from __future__ import annotations

import numpy as np

from roboneuron import GripperProfile, JointLimits, RobotProfile

LINKS = {  # joint: type, axis, largest position, velocity, acceleration
    "base_x": ("prismatic", "1 0 0", 50.0, 0.6, 0.8),
    "base_y": ("prismatic", "0 1 0", 50.0, 0.6, 0.8),
    "base_yaw": ("revolute", "0 0 1", 1e3, 1.0, 2.0),
    "lift": ("prismatic", "0 0 1", 0.8, 0.2, 0.5),
    "shoulder": ("revolute", "0 1 0", 2.0, 1.5, 6.0),
}


def rover() -> RobotProfile:
    """Profile of the rover, base first."""
    urdf, parent = '<robot name="rover"><link name="world"/>', "world"
    for name, (kind, axis, end, fastest, _) in LINKS.items():
        urdf += f'<link name="{name}_link"/><joint name="{name}" type="{kind}">'
        urdf += f'<parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>'
        urdf += f'<limit lower="-{end}" upper="{end}" velocity="{fastest}" effort="50"/></joint>'
        parent = f"{name}_link"
    urdf += f'<link name="tcp"/><joint name="hand" type="fixed"><parent link="{parent}"/>'
    urdf += '<child link="tcp"/><origin xyz="0.4 0 0.3"/></joint></robot>'
    numbers = np.array([row[2:] for row in LINKS.values()])
    return RobotProfile(
        name="rover",
        urdf=urdf,
        base_link="world",
        tcp_link="tcp",
        arm_joints=tuple(LINKS),
        limits=JointLimits(
            lower=-numbers[:, 0],
            upper=numbers[:, 0],
            velocity=numbers[:, 1],
            acceleration=numbers[:, 2],
            effort=np.full(len(LINKS), 50.0),
        ),
        home_rad=np.array([0.0, 0.0, 0.0, 0.3, 0.5]),
        gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.05),
    )
