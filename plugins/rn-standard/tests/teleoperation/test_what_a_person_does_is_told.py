"""What control tells of a row of a lead: the displacement of the TCP that was commanded."""

from __future__ import annotations

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import profile
from rn_standard.teleoperation.executed import Executed, displacement
from rn_standard.teleoperation.rows import Acting
from roboneuron import (
    JointCommand,
    JointSample,
    Pose,
    matrix_from_quaternion,
    matrix_from_rotvec,
)

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785, 0.04])


@pytest.fixture
def controller() -> UrdfController:
    made = UrdfController(None, profile())
    made.load()
    return made


def sample(position: np.ndarray) -> JointSample:
    names = (*profile().arm_joints, "fr3_finger_joint1")
    return JointSample(names=names, position=position, stamp_ns=0)


def test_displacements_of_commands_lead_to_where_the_joints_are(
    controller: UrdfController,
) -> None:
    random = np.random.default_rng(0)
    executed = Executed(poses=lambda joints: (controller.forward(joints),))
    place, turn = np.zeros(3), np.eye(3)
    joints = HOME.copy()
    begin = controller.forward(sample(joints))
    for _ in range(100):
        target = joints[:7] + random.normal(0, 0.01, 7)
        executed.begin()
        executed.start = sample(joints)
        executed.command = JointCommand(
            names=profile().arm_joints, position=target, duration_s=0.02
        )
        moved = np.array(executed.displacement())
        place, turn = place + moved[:3], matrix_from_rotvec(moved[3:]) @ turn
        joints[:7] = target
    end = controller.forward(sample(joints))
    # sums of a hundred float64 numbers
    np.testing.assert_allclose(place, end.position_m - begin.position_m, atol=1e-12)
    before, after = (matrix_from_quaternion(pose.quaternion_xyzw) for pose in (begin, end))
    np.testing.assert_allclose(turn @ before, after, atol=1e-9)


def test_nothing_sent_is_no_displacement_and_two_arms_tell_none() -> None:
    still = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0, 0, 0, 1.0]), stamp_ns=0)
    executed = Executed(poses=lambda joints: (still, still))
    assert executed.displacement() == (0.0,) * 6
    executed.start = sample(HOME)
    assert executed.displacement() == (0.0,) * 6
    executed.command = JointCommand(names=("fr3_joint1",), position=np.zeros(1), duration_s=0.1)
    assert executed.displacement() == ()


def test_a_displacement_turns_in_the_base() -> None:
    quarter = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    start = Pose(position_m=np.ones(3), quaternion_xyzw=quarter, stamp_ns=0)
    end = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0, 0, 0, 1.0]), stamp_ns=0)
    np.testing.assert_allclose(displacement(start, end), [-1, -1, -1, 0, 0, -np.pi / 2])


@pytest.mark.parametrize("gripper", [None, 0.25])
def test_it_survives_its_message(gripper: float | None) -> None:
    moved = (0.01, 0.0, -0.02, 0.0, 0.1, 0.0)
    told = Acting(who="person", session="a", number=3, moved=moved, gripper_open=gripper)
    assert Acting.from_message(told.to_message()) == told
