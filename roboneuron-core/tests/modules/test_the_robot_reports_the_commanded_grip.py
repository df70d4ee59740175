"""The robot module says which opening was commanded last: what fingers around an object measure
does not tell it.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import GripperProfile, JointCommand
from roboneuron.modules.robot import RobotModule
from roboneuron.modules.status import StatusWriter

GRIPPER = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)


@pytest.fixture
def robot() -> Any:
    module = RobotModule.__new__(RobotModule)
    module._gripper, module._opening = GRIPPER, -1.0
    module.status = StatusWriter("arm/robot")
    return module


def command(**positions: float) -> JointCommand:
    return JointCommand(
        names=tuple(positions), position=np.array(list(positions.values())), duration_s=0.1
    )


def told(robot: Any) -> str | None:
    found: str | None = robot.status.report().metrics.get("gripper_commanded")
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
    robot._gripper = None
    robot._note_gripper(SimpleNamespace(names=("finger",)))
    assert told(robot) is None
