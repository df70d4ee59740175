"""The robot module says which opening was commanded last: what fingers around an object measure
does not tell it.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import GripperProfile, JointCommand, JointSample, RobotState
from roboneuron.modules.robot import RobotModule
from roboneuron.modules.status import StatusWriter

GRIPPER = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)


@pytest.fixture
def robot() -> Any:
    module = RobotModule.__new__(RobotModule)
    module._grippers, module._openings = {"": GRIPPER}, {}
    module.status = StatusWriter("arm/robot")
    return module


def command(**positions: float) -> JointCommand:
    return JointCommand(
        names=tuple(positions), position=np.array(list(positions.values())), duration_s=0.1
    )


def told(robot: Any, name: str = "gripper_commanded") -> str | None:
    found: str | None = robot.status.report().metrics.get(name)
    return found


def test_the_last_command_of_the_gripper_counts_and_one_of_the_arm_alone_does_not(
    robot: Any,
) -> None:
    robot._note_gripper(command(a=0.1))
    assert told(robot) is None
    robot._note_gripper(command(a=0.1, finger=0.01))
    robot._note_gripper(command(a=0.2))
    assert told(robot) == "0.25"


def test_a_change_is_reported_at_once_and_a_repetition_is_not(robot: Any) -> None:
    for position, is_new in ((0.04, True), (0.04, False), (0.0, True), (0.0004, False)):
        robot.status.changed.clear()
        robot._note_gripper(command(finger=position))
        assert robot.status.changed.is_set() == is_new, position


def test_a_robot_without_a_gripper_reports_none(robot: Any) -> None:
    robot._grippers = {}
    robot._note_gripper(SimpleNamespace(names=("finger",)))
    assert told(robot) is None


def test_the_grippers_of_several_arms_are_reported_apart(robot: Any) -> None:
    robot._grippers = {"left": GRIPPER, "right": replace(GRIPPER, joint="other")}
    robot._note_gripper(command(finger=0.01, other=0.04))
    robot._note_gripper(command(other=0.0))
    assert told(robot) is None
    assert told(robot, "left/gripper_commanded") == "0.25"
    assert told(robot, "right/gripper_commanded") == "0"
    report = robot.status.report()
    assert report.gripper_commanded is None
    assert report.gripper_commanded_of("left") == 0.25


def test_the_openings_of_several_arms_are_measured_by_their_joints(robot: Any) -> None:
    robot._grippers = {"left": GRIPPER, "right": replace(GRIPPER, joint="other")}
    robot._measured_hands = ("left", "right")
    joints = JointSample(names=("finger", "other"), position=np.array([0.01, 0.03]))
    robot._note_openings(RobotState(joints=joints, gripper_open=0.9))
    assert told(robot, "left/gripper_open") == "0.25"
    assert told(robot, "right/gripper_open") == "0.75"
    assert told(robot, "gripper_open") is None
