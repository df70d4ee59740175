"""The shipped URDF against an independent evaluation of the official joint table, and against the
profile.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT, joint_limits, velocity_bounds
from rn_robot_fr3.profile import HOME_RAD, profile

# x, y, z [m] and roll [rad] of each joint's origin. Source: franka_description@566ba44
# robots/fr3/kinematics.yaml.
ORIGINS = [
    (0.0, 0.0, 0.333, 0.0),
    (0.0, 0.0, 0.0, -math.pi / 2),
    (0.0, -0.316, 0.0, math.pi / 2),
    (0.0825, 0.0, 0.0, math.pi / 2),
    (-0.0825, 0.384, 0.0, -math.pi / 2),
    (0.0, 0.0, 0.0, math.pi / 2),
    (0.088, 0.0, 0.0, math.pi / 2),
]
FLANGE_M, HAND_YAW_RAD, TCP_M = 0.107, -math.pi / 4, 0.1034


def transform(x: float, y: float, z: float, roll: float, yaw: float) -> NDArray[np.float64]:
    cr, sr, cy, sy = math.cos(roll), math.sin(roll), math.cos(yaw), math.sin(yaw)
    about_x = np.array([[1, 0, 0, x], [0, cr, -sr, y], [0, sr, cr, z], [0, 0, 0, 1]])
    about_z = np.array([[cy, -sy, 0, 0], [sy, cy, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return about_x @ about_z


def tcp_from_table(q: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = np.eye(4)
    for origin, angle in zip(ORIGINS, q, strict=True):
        pose = pose @ transform(*origin, float(angle))
    return (
        pose
        @ transform(0, 0, FLANGE_M, 0, 0)
        @ transform(0, 0, 0, 0, HAND_YAW_RAD)
        @ transform(0, 0, TCP_M, 0, 0)
    )


def random_postures(count: int) -> NDArray[np.float64]:
    limits = joint_limits()
    return np.random.default_rng(7).uniform(limits.lower, limits.upper, (count, 7))


def test_tcp_pose_of_the_urdf_agrees_with_the_official_table() -> None:
    model = pin.buildModelFromXML(profile().urdf)
    data = model.createData()
    frame = model.getFrameId(profile().tcp_link)
    for q in [np.array(HOME_RAD), *random_postures(50)]:
        pin.framesForwardKinematics(model, data, np.concatenate([q, [0.0, 0.0]]))
        # Both are double precision products of a dozen matrices.
        np.testing.assert_allclose(data.oMf[frame].homogeneous, tcp_from_table(q), atol=1e-12)


def test_home_points_straight_down_inside_the_workspace() -> None:
    pose, workspace = tcp_from_table(np.array(HOME_RAD)), profile().workspace
    assert workspace is not None
    np.testing.assert_allclose(pose[:3, 2], [0, 0, -1], atol=1e-12)
    assert (workspace.lower_m < pose[:3, 3]).all()
    assert (pose[:3, 3] < workspace.upper_m).all()


def test_urdf_limits_are_those_of_the_profile() -> None:
    robot, limits, gripper = ET.fromstring(profile().urdf), joint_limits(), profile().gripper
    assert gripper is not None
    by_name = {joint.get("name"): joint.find("limit") for joint in robot.iter("joint")}
    for index, name in enumerate(ARM_JOINTS):
        limit = by_name[name]
        assert limit is not None
        listed = [float(limit.get(key, "nan")) for key in ("lower", "upper", "velocity", "effort")]
        assert listed == [
            limits.lower[index],
            limits.upper[index],
            limits.velocity[index],
            limits.effort[index],
        ]
    finger = by_name[FINGER_JOINT]
    assert finger is not None
    assert [float(finger.get("lower", "nan")), float(finger.get("upper", "nan"))] == [
        gripper.closed_position,
        gripper.open_position,
    ]


def test_every_link_has_a_positive_definite_inertia() -> None:
    model = pin.buildModelFromXML(profile().urdf)
    for name, inertia in list(zip(model.names, model.inertias, strict=True))[1:]:
        assert inertia.mass > 0, name
        assert np.linalg.eigvalsh(inertia.inertia).min() > 0, name


def test_urdf_refers_to_no_mesh_file() -> None:
    assert list(ET.fromstring(profile().urdf).iter("mesh")) == []


def test_velocity_bounds_shrink_towards_a_limit_and_vanish_at_it() -> None:
    limits = joint_limits()
    lowest, highest = velocity_bounds((limits.lower + limits.upper) / 2)
    np.testing.assert_allclose(highest[[0, 2]], limits.velocity[[0, 2]])
    np.testing.assert_allclose(lowest, -highest, atol=1e-12)
    # Joint 1, 0.5 rad before its limit: -0.30 + sqrt(2 * 6 * 0.5).
    _, near = velocity_bounds(limits.upper - 0.5)
    assert near[0] == pytest.approx(-0.30 + math.sqrt(6.0), abs=1e-12)
    lowest_at, highest_at = velocity_bounds(limits.upper)
    np.testing.assert_array_equal(highest_at, np.zeros(7))
    assert (lowest_at < 0).all()
