"""A stop ends where the arm comes to rest soonest, and nothing replaces it before."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_robot_fr3.fci.arm import FciArm
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import JERK_LIMIT_RAD_S3, STOP_ACCELERATION_RAD_S2, braking_distance, plan
from rn_robot_fr3.profile import HOME_RAD


class Robot:
    """Takes motions; they last until somebody says otherwise."""

    def __init__(self) -> None:
        self.motions: list[Any] = []
        self.is_in_control = False
        self.state = SimpleNamespace(dq_d=[0.0] * 7, ddq_d=[0.0] * 7)

    def join_motion(self, _: float) -> None:
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
        JointMotion=lambda target, reference: ("stop", reference, target),
        ReferenceType=SimpleNamespace(Relative="relative"),
        RelativeDynamicsFactor=lambda *_: None,
        JointState=lambda q: q,
        JointWaypoint=lambda state, **_: state,
        JointWaypointMotion=lambda waypoints, **_: ("go", waypoints),
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
    assert [motion[0] for motion in robot.motions] == ["go", "stop"]


def test_a_stop_is_a_motion_ahead_and_not_back(arm: FciArm, robot: Robot) -> None:
    robot.state.dq_d = [1.0, -1.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    robot.state.ddq_d = [0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0]
    go(arm)
    arm.stop()
    _, reference, way = robot.motions[-1]
    assert reference == "relative"  # to the command at the hand-over: what passes until then does not count
    assert 0.055 < way[0] < 0.058  # 1 / (2 * 9.5) for the acceleration, 9.5 / (2 * 1800) for the jerk
    assert -0.072 < way[1] < -0.068  # joint 2 with 7.4
    assert (way[[2, 4, 5, 6]] == 0.0).all()


def test_the_end_of_a_connection_stops_in_the_same_way(arm: FciArm, robot: Robot) -> None:
    robot.state.dq_d = [1.0] * 7
    go(arm)
    arm.close()
    arm.close()
    assert [motion[0] for motion in robot.motions] == ["go", "stop"]


@settings(max_examples=30)
@given(velocity=st.floats(-2.6, 2.6), acceleration=st.floats(-7.4, 7.4))
def test_the_braking_distance_is_that_of_limited_jerk(velocity: float, acceleration: float) -> None:
    way = braking_distance(np.full(7, velocity), np.full(7, acceleration))
    limit, jerk = STOP_ACCELERATION_RAD_S2[0], JERK_LIMIT_RAD_S3[0]
    ahead = 1.0 if velocity + acceleration * abs(acceleration) / (2 * jerk) >= 0.0 else -1.0
    speed, rate, gone, step_s = ahead * velocity, ahead * acceleration, 0.0, 1e-4
    for _ in range(5_000):  # 0.5 s: brake until what is left is the last ramp
        if rate < 0.0 and speed <= rate**2 / (2 * jerk):
            break
        next_rate = max(rate - jerk * step_s, -limit)
        gone += speed * step_s + rate * step_s**2 / 2.0
        speed, rate = speed + (rate + next_rate) / 2.0 * step_s, next_rate
    gone += abs(rate) ** 3 / (6 * jerk**2)  # the last ramp
    assert way[0] == pytest.approx(ahead * gone, abs=1e-3)  # of up to 0.46 rad: one step of 0.1 ms


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
    assert [motion[0] for motion in robot.motions] == ["go", "stop", "go", "stop"]


def test_nobody_waits_where_no_stop_was_asked_for(arm: FciArm) -> None:
    go(arm)
    began_s = time.monotonic()
    arm.await_rest()
    assert time.monotonic() - began_s < 0.2
