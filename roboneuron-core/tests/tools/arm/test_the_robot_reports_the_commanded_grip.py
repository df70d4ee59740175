"""The robot module says which opening was commanded last: what fingers around an object measure
does not tell it.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import (
    ArmProfile,
    GripperProfile,
    JointCommand,
    JointSample,
    RobotProfile,
    RobotState,
)
from roboneuron.modules.report import Report
from roboneuron.modules.status import StatusWriter
from roboneuron.tools.arm import grip_reports
from roboneuron.tools.arm.grip_reports import GripReports, commanded_opening, join

GRIPPER = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
ONE_ARM = RobotProfile(name="arm", gripper=GRIPPER)
TWO_ARMS = RobotProfile(
    name="pair",
    arm_joints=("left", "right"),
    arms=tuple(
        ArmProfile(name=name, joints=(name,), base_link="base", tcp_link="tip", gripper=gripper)
        for name, gripper in (("left", GRIPPER), ("right", replace(GRIPPER, joint="other")))
    ),
)


class Robot:
    """A robot module as far as its grippers are reported."""

    def __init__(self, profile: RobotProfile) -> None:
        self.status = StatusWriter("arm/robot")
        self.reports = GripReports(profile, self.status)

    def send(self, **positions: float) -> None:
        names, position = tuple(positions), np.array(list(positions.values()))
        self.reports.note_sent(JointCommand(names=names, position=position, duration_s=0.1))

    def read(self, opening: float | None, **positions: float) -> None:
        names, position = tuple(positions), np.array(list(positions.values()))
        joints = JointSample(names=names, position=position)
        self.reports.note_state(RobotState(joints=joints, gripper_open=opening))

    def told(self, name: str = "gripper_commanded") -> str | None:
        return self.status.report().metrics.get(name)


def test_the_last_command_of_the_gripper_counts_and_one_of_the_arm_alone_does_not() -> None:
    robot = Robot(ONE_ARM)
    robot.send(a=0.1)
    assert robot.told() is None
    robot.send(a=0.1, finger=0.01)
    robot.send(a=0.2)
    assert robot.told() == "0.25"


def test_a_change_is_reported_at_once_and_a_repetition_is_not() -> None:
    robot = Robot(ONE_ARM)
    for position, is_new in ((0.04, True), (0.04, False), (0.0, True), (0.0004, False)):
        robot.status.changed.clear()
        robot.send(finger=position)
        assert robot.status.changed.is_set() == is_new, position


def test_a_change_by_the_bound_itself_is_told_with_the_next_report(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """0.25 is exact in binary."""
    monkeypatch.setattr(grip_reports, "_CHANGE", 0.25)
    robot = Robot(ONE_ARM)
    robot.send(finger=0.02)
    robot.status.changed.clear()
    robot.send(finger=0.03)
    assert robot.told() == "0.75"
    assert not robot.status.changed.is_set()


@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_any_opening_is_told_at_the_first_command(opening: float) -> None:
    robot = Robot(ONE_ARM)
    robot.send(finger=0.04 * opening)
    assert robot.status.changed.is_set()
    assert robot.told() == f"{opening:g}"


def test_a_robot_without_a_gripper_reports_none() -> None:
    robot = Robot(RobotProfile(name="arm"))
    robot.send(finger=0.01)
    robot.read(None, a=0.1)
    assert robot.told() is None
    assert robot.told("gripper_open") is None


def test_the_opening_of_the_only_arm_is_as_the_driver_tells_it() -> None:
    robot = Robot(ONE_ARM)
    robot.read(0.5, finger=0.04)
    assert robot.told("gripper_open") == "0.5"
    robot.reports.note_state(None)
    assert robot.told("gripper_open") is None


def test_the_grippers_of_several_arms_are_reported_apart() -> None:
    robot = Robot(TWO_ARMS)
    robot.send(finger=0.01, other=0.04)
    robot.send(other=0.0)
    assert robot.told() is None
    assert robot.told("left/gripper_commanded") == "0.25"
    assert robot.told("right/gripper_commanded") == "0"
    report = robot.status.report()
    assert commanded_opening(report, "") is None
    assert commanded_opening(report, "left") == 0.25


def test_the_openings_of_several_arms_are_measured_by_their_joints() -> None:
    robot = Robot(TWO_ARMS)
    robot.read(0.9, finger=0.01, other=0.03)
    assert robot.told("left/gripper_open") == "0.25"
    assert robot.told("right/gripper_open") == "0.75"
    assert robot.told("gripper_open") is None


@pytest.mark.parametrize("told", ["", "wide", "nan", "inf"])
def test_what_is_no_opening_counts_as_not_commanded(told: str) -> None:
    assert commanded_opening(Report(metrics={"gripper_commanded": told}), "") is None


def test_only_robot_modules_report_grippers() -> None:
    status = StatusWriter("arm/robot")
    module: Any = SimpleNamespace(profile=ONE_ARM, status=status, on_sent=[], on_state=[])
    for kind in ("control", "robot"):
        host: Any = SimpleNamespace(settings=SimpleNamespace(kind=kind), on_configured=[])
        join(host)
        for extend in host.on_configured:
            extend(module)
        assert (len(module.on_sent), len(module.on_state)) == (kind == "robot",) * 2
