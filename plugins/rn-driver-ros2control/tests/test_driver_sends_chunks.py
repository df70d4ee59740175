"""Mode chunks: a target goes to the controller with those that are planned after it, for a bounded
time, and a hold or a newer target takes the place of all of them.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from pydantic import ValidationError

from rn_driver_ros2control.driver import Ros2ControlDriver
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_testing.waiting import wait_until
from roboneuron import InvalidInputError, JointCommand

ROW_S = 0.05
SPEED_RAD_S = 0.5
CYCLES_S = 0.4
"""Cycles of the stand-in and of this test on a busy machine; the chunk would go on for longer."""


def row(number: int, speed_rad_s: float = SPEED_RAD_S, duration_s: float = ROW_S) -> JointCommand:
    """Row `number`, from 1 on, of a steady motion of the last joint."""
    end = HOME_RAD[6] + number * ROW_S * speed_rad_s
    return JointCommand(
        names=ARM_JOINTS, position=np.array([*HOME_RAD[:6], end]), duration_s=duration_s
    )


def rows(count: int, first: int = 1) -> list[JointCommand]:
    return [row(number) for number in range(first, first + count)]


def send(driver: Ros2ControlDriver, chunk: list[JointCommand]) -> JointCommand:
    return driver.send_ahead(chunk[0], chunk[1:])


def last_joint(driver: Ros2ControlDriver) -> float:
    return float(driver.read().joints.position[6]) - HOME_RAD[6]


def speed(driver: Ros2ControlDriver) -> float:
    velocity = driver.read().joints.velocity
    assert velocity is not None
    return float(np.abs(velocity).max())


def times_s(message) -> list[float]:
    return [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in message.points]


def test_targets_within_the_horizon_are_one_message_with_their_times(rig):
    driver = rig.driver(mode="chunks", horizon_s=0.2)
    sent = send(driver, rows(8))
    (message,) = rig.link.sent
    assert times_s(message) == pytest.approx([0.05, 0.1, 0.15, 0.2, 0.25])
    ends = [point.positions[6] - HOME_RAD[6] for point in message.points]
    assert ends == pytest.approx([0.025, 0.05, 0.075, 0.1, 0.125])
    assert sent.position[6] == pytest.approx(HOME_RAD[6] + 0.025)
    assert sent.duration_s == pytest.approx(ROW_S)


@pytest.mark.parametrize("mode", ["topic", "action"])
def test_other_modes_send_the_target_alone(rig, mode):
    driver = rig.driver(mode=mode)
    send(driver, rows(8))
    assert [len(message.points) for message in rig.link.sent] == [1]


def test_a_driver_that_falls_silent_leaves_an_arm_at_rest_after_the_horizon(rig):
    driver = rig.driver(mode="chunks", horizon_s=0.2)
    send(driver, rows(20))
    wait_until(lambda: last_joint(driver) > 0.1, 10.0)  # it stands before it moves, too
    wait_until(lambda: speed(driver) < 1e-6, 10.0)
    assert last_joint(driver) == pytest.approx(5 * ROW_S * SPEED_RAD_S, abs=1e-3)


def test_a_newer_chunk_replaces_what_is_left(rig):
    driver = rig.driver(mode="chunks", horizon_s=1.0)
    send(driver, rows(20))
    wait_until(lambda: last_joint(driver) > 0.05, 10.0)
    send(driver, [row(0), row(0)])
    wait_until(lambda: abs(last_joint(driver)) < 1e-3, 10.0)
    time.sleep(0.3)
    assert abs(last_joint(driver)) < 1e-3


@pytest.mark.parametrize("mode", ["topic", "chunks"])
def test_a_hold_beats_a_chunk_under_way_as_soon_as_a_single_target(rig, mode):
    """The bound is that of mode topic: braking with 80 % of the acceleration limit."""
    driver = rig.driver(mode=mode, horizon_s=1.0)
    if mode == "chunks":
        send(driver, rows(20))
    else:
        driver.send(row(20, duration_s=1.0))
    wait_until(lambda: last_joint(driver) > 0.1, 10.0)
    held_s, place = time.monotonic(), last_joint(driver)
    driver.hold()
    wait_until(lambda: speed(driver) < 1e-6, 10.0)
    limits = profile().limits
    assert limits is not None
    braking_s = SPEED_RAD_S / (0.8 * float(limits.acceleration[6]))
    assert time.monotonic() - held_s < braking_s + CYCLES_S
    rested = last_joint(driver)
    assert rested - place < SPEED_RAD_S * (braking_s + CYCLES_S)
    time.sleep(0.3)
    assert last_joint(driver) == pytest.approx(rested, abs=1e-6)


def test_planned_targets_are_within_the_limits_of_position_and_velocity(rig):
    driver = rig.driver(mode="chunks", horizon_s=1.0)
    limits = profile().limits
    assert limits is not None
    far = row(1, speed_rad_s=1000.0)
    send(driver, [row(1), far])
    first, second = rig.link.sent[0].points
    assert second.positions[6] == pytest.approx(limits.upper[6])
    step = second.positions[6] - first.positions[6]
    took_s = times_s(rig.link.sent[0])[1] - times_s(rig.link.sent[0])[0]
    assert took_s == pytest.approx(step / limits.velocity[6], rel=1e-6)


def test_a_planned_target_that_would_outlast_the_horizon_ends_the_chunk(rig):
    driver = rig.driver(mode="chunks", horizon_s=0.12)
    send(driver, [row(1), row(2), row(3, duration_s=0.5), row(4)])
    assert len(rig.link.sent[0].points) == 2


@pytest.mark.parametrize(
    "bad",
    [
        JointCommand(names=("x",), position=np.zeros(1), duration_s=0.1),
        JointCommand(names=ARM_JOINTS, position=np.full(7, np.nan), duration_s=0.1),
        JointCommand(names=ARM_JOINTS, position=np.zeros(7), duration_s=0.0),
    ],
    ids=["joint", "nan", "time"],
)
def test_a_bad_planned_target_refuses_the_whole(rig, bad):
    driver = rig.driver(mode="chunks")
    with pytest.raises(InvalidInputError):
        driver.send_ahead(row(1), [row(2), bad])
    assert rig.link.sent == []


def test_joints_that_a_later_command_lacks_stay_at_the_target_not_at_what_was_planned(rig):
    driver = rig.driver(mode="chunks", horizon_s=1.0)
    send(driver, rows(10))
    one = JointCommand(names=ARM_JOINTS[:1], position=np.array(HOME_RAD[:1]), duration_s=0.1)
    driver.send(one)
    end = rig.link.sent[-1].points[-1].positions[6]
    assert end == pytest.approx(row(1).position[6])


def test_a_blocked_arm_is_a_fault_in_a_chunk(rig):
    driver = rig.driver(mode="chunks", horizon_s=1.0, path_tolerance=0.02)
    rig.link.controller.blocked = True
    send(driver, rows(20))
    wait_until(lambda: "path tolerance" in str(driver.read().detail["fault"]), 10.0)
    assert [len(message.points) for message in rig.link.sent] == [20, 1]


def test_an_end_of_a_chunk_that_is_reached_is_no_fault(rig):
    """The arm has left the first target long before the tolerance of the end is due."""
    options = {"goal_tolerance": 0.01, "goal_time_tolerance_s": 0.1}
    driver = rig.driver(mode="chunks", horizon_s=1.0, **options)
    send(driver, rows(10))
    wait_until(lambda: last_joint(driver) > 0.24, 10.0)
    time.sleep(0.2)
    assert driver.read().detail["fault"] == ""


def test_chunks_do_not_come_to_rest_at_each_target():
    with pytest.raises(ValidationError, match="needs interpolation = 'linear'"):
        Ros2ControlOptions(mode="chunks", interpolation="cubic")
