"""The shipped URDF, with our own frames, against an independent evaluation of the published
table.
"""

from __future__ import annotations

import time
import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from rn_controller_urdf.controller import UrdfController
from rn_robot_lerobot.arm import ARM_JOINTS, JOINTS, SO101
from rn_robot_lerobot.profile import lekiwi_profile, so101_profile
from roboneuron import JointSample, RobotProfile

F64 = NDArray[np.float64]

# xyz [m] and rpy [rad] of each joint's origin; every joint turns about its own z. Source:
# TheRobotStudio/SO-ARM100 Simulation/SO101 so101_new_calib.
ORIGINS = (
    ((0.0388353, -8.97657e-09, 0.0624), (3.14159, 4.18253e-17, -3.14159)),
    ((-0.0303992, -0.0182778, -0.0542), (-1.5708, -1.5708, 0.0)),
    ((-0.11257, -0.028, 1.73763e-16), (-3.63608e-16, 8.74301e-16, 1.5708)),
    ((-0.1349, 0.0052, 3.62355e-17), (4.02456e-15, 8.67362e-16, -1.5708)),
    ((5.55112e-17, -0.0611, 0.0181), (1.5708, 0.0486795, 3.14159)),
)
FRAME = ((-0.0079, -0.000218121, -0.0981274), (0.0, 3.14159, 0.0))
ROUNDING = 5e-5
"""The table has angles of five digits, for arms of 0.4 m; ours is exact."""


def transform(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> F64:
    pose = np.eye(4)
    pose[:3, :3] = pin.rpy.rpyToMatrix(*rpy)
    pose[:3, 3] = xyz
    return pose


def frame_from_table(q: F64) -> F64:
    pose = np.eye(4)
    for (xyz, rpy), angle in zip(ORIGINS, q, strict=True):
        pose = pose @ transform(xyz, rpy) @ transform((0, 0, 0), (0, 0, float(angle)))
    return pose @ transform(*FRAME)


def place(link: str, q: F64, robot: RobotProfile) -> F64:
    model = pin.buildModelFromXML(robot.urdf)
    data = model.createData()
    full = np.zeros(model.nq)
    for name, angle in zip(ARM_JOINTS, q, strict=True):
        full[model.joints[model.getJointId(name)].idx_q] = angle
    pin.framesForwardKinematics(model, data, full)
    pose: F64 = data.oMf[model.getFrameId(link)].homogeneous
    return pose


def test_the_published_gripper_frame_is_where_the_table_puts_it() -> None:
    random = np.random.default_rng(7)
    for q in (
        np.zeros(5),
        np.array(SO101.home_rad),
        *random.uniform(SO101.lower_rad, SO101.upper_rad, (50, 5)),
    ):
        np.testing.assert_allclose(
            place("gripper_frame_link", q, so101_profile()), frame_from_table(q), atol=ROUNDING
        )


@pytest.mark.parametrize("made", [so101_profile, lekiwi_profile])
def test_home_points_down_inside_the_workspace(made: Callable[[], RobotProfile]) -> None:
    robot = made()
    pose, workspace = place(robot.tcp_link, np.array(SO101.home_rad), robot), robot.workspace
    assert workspace is not None
    # a tenth of a degree
    np.testing.assert_allclose(pose[:3, 2], [0, 0, -1], atol=2e-3)
    assert (workspace.lower_m < pose[:3, 3]).all()
    assert (pose[:3, 3] < workspace.upper_m).all()


def test_a_lekiwis_arm_is_an_so101_on_its_base() -> None:
    robot, random = lekiwi_profile(), np.random.default_rng(7)
    # its pan axis is 67 mm in front of the wheels' centre, 152.4 mm above the floor
    np.testing.assert_allclose(
        place("so101_shoulder", np.zeros(5), robot)[:3, 3], [0.067, 0.0, 0.1524], atol=1e-6
    )
    mount = place("so101_base", np.zeros(5), robot)
    for q in random.uniform(SO101.lower_rad, SO101.upper_rad, (20, 5)):
        np.testing.assert_allclose(
            place(robot.tcp_link, q, robot),
            mount @ place(robot.tcp_link, q, so101_profile()),
            atol=1e-9,
        )


def test_urdf_limits_are_those_of_the_profile() -> None:
    limits = {
        joint.get("name"): joint.find("limit") for joint in ET.fromstring(so101_profile().urdf)
    }
    rows = zip(ARM_JOINTS, SO101.lower_rad, SO101.upper_rad, SO101.effort_nm, strict=True)
    for name, lower, upper, effort in rows:
        expected = [lower, upper, SO101.velocity_rad_s, effort]
        limit = limits[name]
        assert limit is not None
        keys = ("lower", "upper", "velocity", "effort")
        assert [float(limit.get(key, "nan")) for key in keys] == expected
    jaw = limits[JOINTS[-1]]
    assert jaw is not None
    assert [float(jaw.get(k, "nan")) for k in ("lower", "upper")] == [
        SO101.jaw_closed_rad,
        SO101.jaw_open_rad,
    ]


def test_every_link_has_a_positive_definite_inertia() -> None:
    model = pin.buildModelFromXML(so101_profile().urdf)
    for name, inertia in list(zip(model.names, model.inertias, strict=True))[1:]:
        assert inertia.mass > 0, name
        assert np.linalg.eigvalsh(inertia.inertia).min() > 0, name


@pytest.mark.parametrize("jaw_rad", [SO101.jaw_closed_rad, 0.13, SO101.jaw_open_rad])
@pytest.mark.parametrize("made", [so101_profile, lekiwi_profile])
def test_no_opening_of_the_jaws_counts_as_a_collision(
    jaw_rad: float, made: Callable[[], RobotProfile]
) -> None:
    controller = UrdfController(None, made())
    controller.load()
    posture = JointSample(
        names=JOINTS, position=np.array([*SO101.home_rad, jaw_rad]), stamp_ns=time.time_ns()
    )
    assert controller.inspect(posture).near == ()


def test_an_arm_that_reaches_into_its_base_is_a_collision() -> None:
    controller = UrdfController(None, lekiwi_profile())
    controller.load()
    bent = (0.0, -1.2, 1.69, 1.5, 0.0, 0.0)
    posture = JointSample(names=JOINTS, position=np.array(bent), stamp_ns=time.time_ns())
    near = {body for pair in controller.inspect(posture).near for body in (pair.first, pair.second)}
    assert any("lekiwi_base" in body for body in near), near
