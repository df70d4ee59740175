"""Robots with several arms: channels name the arm, and are matched by that name; with one arm
nothing is named.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import (
    EE_DELTA,
    ActionChunk,
    ArmProfile,
    ControlSpace,
    GripperProfile,
    JointSample,
    RobotProfile,
    robot_space,
)
from roboneuron.errors import InvalidInputError, PlanningError
from roboneuron.modules.inference.agreement import agree


def _arm(name: str, **values: Any) -> ArmProfile:
    return ArmProfile(
        name=name,
        joints=(f"{name}_a", f"{name}_b"),
        base_link=f"{name}_base",
        tcp_link=f"{name}_tcp",
        gripper=GripperProfile(joint=f"{name}_finger", closed_position=0.0, open_position=0.04),
        **values,
    )


ARMS = (_arm("left"), _arm("right"))
PAIR = RobotProfile(
    name="pair",
    base_link="table",
    tcp_link="left_tcp",
    arm_joints=("left_a", "left_b", "right_a", "right_b"),
    gripper=ARMS[0].gripper,
    arms=ARMS,
)
SINGLE = RobotProfile(
    name="single",
    base_link="base",
    tcp_link="tcp",
    arm_joints=("a", "b"),
    gripper=ARMS[0].gripper,
)
ONE_ROW = [0.1, 0.2, 0.5, 0.3, 0.4, 1.0]


def test_channels_of_joints_come_arm_after_arm_with_the_gripper_of_each() -> None:
    assert robot_space("joint_position", PAIR).keys == (
        *("left/left_a", "left/left_b", "left/gripper_open"),
        *("right/right_a", "right/right_b", "right/gripper_open"),
    )


def test_each_arm_has_a_pose_of_its_own() -> None:
    space = robot_space("ee_pose", PAIR)
    of_one = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper_open")
    assert space.keys == tuple(f"{arm}/{key}" for arm in ("left", "right") for key in of_one)
    assert space.quaternions == ([3, 4, 5, 6], [11, 12, 13, 14])
    assert {channel.frame for channel in space.channels} == {"base", ""}


def test_one_arm_is_not_named() -> None:
    assert robot_space("joint_position", SINGLE).keys == ("a", "b", "gripper_open")
    assert robot_space("ee_pose", SINGLE).keys[:3] == ("x", "y", "z")
    (arm,) = SINGLE.each_arm
    assert (arm.name, arm.joints, arm.base_link, arm.tcp_link) == ("", ("a", "b"), "base", "tcp")
    assert SINGLE.grippers == (SINGLE.gripper,)


def test_the_7_vector_is_not_offered_for_several_arms() -> None:
    with pytest.raises(InvalidInputError, match="'ee_delta' moves one arm; robot 'pair' has 2"):
        robot_space("ee_delta", PAIR)
    with pytest.raises(PlanningError, match="'ee_delta' moves one arm"):
        agree(EE_DELTA, PAIR, ("ee_delta",), backend="one", controller="urdf")


def test_arm_joints_are_those_of_the_arms_in_order() -> None:
    with pytest.raises(InvalidInputError, match=r"Robot 'pair': arm_joints are .* its arms have"):
        replace(PAIR, arm_joints=("right_a", "right_b", "left_a", "left_b"))


def _declared(kind: str) -> ControlSpace:
    executed = robot_space(kind, PAIR, 10.0)
    return replace(executed, channels=executed.channels[3:] + executed.channels[:3])


def _converted(kind: str) -> ActionChunk:
    declared = _declared(kind)
    agreement = agree(declared, PAIR, ("joint_position",), backend="policy", controller="urdf")
    joints = JointSample(
        names=("right_a", "right_b", "left_a", "left_b", "left_finger"),
        position=np.array([10.0, 20.0, 30.0, 40.0, 0.01]),
    )
    chunk = ActionChunk(actions=np.array([ONE_ROW]), step_s=0.1, space=declared)
    return agreement.convert(chunk, joints)


def test_a_policy_that_has_the_right_arm_first_is_put_in_order() -> None:
    chunk = _converted("joint_position")
    assert chunk.space.keys == robot_space("joint_position", PAIR).keys
    assert chunk.actions[0].tolist() == [0.3, 0.4, 1.0, 0.1, 0.2, 0.5]


def test_deltas_are_added_to_the_joints_of_their_own_arm() -> None:
    chunk = _converted("joint_delta")
    assert chunk.actions[0].tolist() == [30.3, 40.4, 1.0, 10.1, 20.2, 0.5]


def test_a_policy_for_one_arm_is_refused_with_what_it_lacks() -> None:
    declared = robot_space("joint_position", SINGLE)
    with pytest.raises(PlanningError, match="the backend lacks left/left_a, left/left_b"):
        agree(declared, PAIR, ("joint_position",), backend="policy", controller="urdf")


def test_each_gripper_counts_as_there_within_a_fortieth_of_its_travel() -> None:
    assert PAIR.tolerance("left_finger") == PAIR.tolerance("right_finger") == pytest.approx(0.001)
    assert PAIR.tolerance("right_b") == 0.01
