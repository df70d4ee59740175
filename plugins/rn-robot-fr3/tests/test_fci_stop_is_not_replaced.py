"""A stop uses all of the acceleration, at which franka-sim aborts motions that are replaced: nothing replaces it."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.fci.arm import FciArm
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import plan
from rn_robot_fr3.profile import HOME_RAD


class Robot:
    """Takes motions; they last until somebody says otherwise."""

    def __init__(self) -> None:
        self.motions: list[str] = []
        self.is_in_control = False

    def move(self, motion: Any, **_: object) -> None:
        self.motions.append(motion)
        self.is_in_control = True


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.fixture
def arm(robot: Robot) -> FciArm:
    client = SimpleNamespace(
        Errors=type("Errors", (), {}),
        JointStopMotion=lambda: "stop",
        RelativeDynamicsFactor=lambda *_: None,
        JointState=lambda q: q,
        JointWaypoint=lambda state, **_: state,
        JointWaypointMotion=lambda waypoints, **_: "go",
    )
    made = FciArm(FciDriverOptions(host="10.0.0.1"), client)
    made._robot = robot
    return made


def go(arm: FciArm) -> None:
    home = np.array(HOME_RAD)
    arm.go(plan(home, home + 0.1, 1.0, 0.3))


def test_a_second_stop_leaves_the_first_one_alone(arm: FciArm, robot: Robot) -> None:
    go(arm)
    arm.stop()
    arm.stop()
    assert robot.motions == ["go", "stop"]


def test_an_arm_that_stands_is_not_stopped(arm: FciArm, robot: Robot) -> None:
    arm.stop()
    assert robot.motions == []


def test_a_motion_waits_for_the_end_of_the_stop(arm: FciArm, robot: Robot) -> None:
    go(arm)
    arm.stop()
    waiting = threading.Thread(target=arm.await_rest)
    waiting.start()
    time.sleep(0.05)  # what is looked for is that nothing happens
    assert waiting.is_alive()
    robot.is_in_control = False
    waiting.join(5.0)
    assert not waiting.is_alive()
    go(arm)
    arm.stop()
    assert robot.motions == ["go", "stop", "go", "stop"]


def test_nobody_waits_where_no_stop_was_asked_for(arm: FciArm) -> None:
    go(arm)
    began_s = time.monotonic()
    arm.await_rest()
    assert time.monotonic() - began_s < 0.2
