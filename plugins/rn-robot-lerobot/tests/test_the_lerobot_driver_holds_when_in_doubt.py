"""The driver for LeRobot's arms holds when in doubt."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from stand_in_follower import NormMode, StandInFollower, StandInMotor

from rn_robot_lerobot import lerobot_driver
from rn_robot_lerobot.arm import JOINTS, SO101
from rn_robot_lerobot.bus.arm import SerialArm
from rn_robot_lerobot.bus.chain import BusFaults
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_robot_lerobot.lerobot_arm import calibration_of, connect, map_motors
from rn_robot_lerobot.lerobot_driver import LerobotDriver
from rn_robot_lerobot.lerobot_options import LerobotDriverOptions, MotorOption
from rn_robot_lerobot.profile import so101_profile
from rn_testing.fakes import MemoryTopics
from rn_testing.waiting import holds_within, wait_until
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    NotReadyError,
    StateError,
    UnsafeError,
)

REST_S = 0.5


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "so101.json"
    told = {name: asdict(motor) for name, motor in ASSEMBLED_SO101.calibration().items()}
    path.write_text(json.dumps(told))
    return path


@pytest.fixture
def arm() -> Iterator[SerialArm]:
    with SerialArm() as arm:
        yield arm


@pytest.fixture
def follower(arm: SerialArm, path: Path, monkeypatch: pytest.MonkeyPatch) -> StandInFollower:
    follower = StandInFollower(arm, path)
    monkeypatch.setattr(lerobot_driver, "make_robot", lambda _: follower)
    return follower


@pytest.fixture
def driver(follower: StandInFollower) -> Iterator[LerobotDriver]:
    driver = LerobotDriver(LerobotDriverOptions(), so101_profile(), MemoryTopics())
    driver.open()
    yield driver
    driver.close()


def turn(driver: LerobotDriver, target: float = 1.2, seconds: float = 4.0) -> JointCommand:
    return driver.send(
        JointCommand(names=("shoulder_pan",), position=np.array([target]), duration_s=seconds)
    )


def turn_until(driver: LerobotDriver, done: Callable[[], bool], target: float, s: float) -> None:
    """A busy machine keeps the bus silent, after which the driver drops its goal: the next command
    moves the arm all the same.
    """
    for _ in range(4):
        turn(driver, target, s)
        if holds_within(done, 5.0):
            return
    raise AssertionError(f"it does not move to {target}: {driver.read()}")


def turning(driver: LerobotDriver, arm: SerialArm) -> float:
    """Start a long rotation; return the current time [monotonic s]."""
    turn_until(driver, lambda: arm.position[0] > 0.15, 1.2, 4.0)
    return time.monotonic()


def later(since_s: float, seconds: float) -> Callable[[], bool]:
    return lambda: time.monotonic() > since_s + seconds


def test_it_reads_the_joints_and_moves_them_where_it_is_sent(
    driver: LerobotDriver, arm: SerialArm
) -> None:
    state = driver.read()
    assert state.joints.names == JOINTS
    np.testing.assert_allclose(state.joints.position[:5], SO101.home_rad, atol=0.01)
    assert state.gripper_open == pytest.approx(1.0, abs=0.01)
    command = JointCommand(
        names=("shoulder_pan", "wrist_roll", "gripper"),
        position=np.array([0.4, -0.5, 0.6]),
        duration_s=0.5,
    )
    assert driver.send(command).duration_s >= 0.5
    expected = [0.4, *SO101.home_rad[1:4], -0.5, 0.6]
    wait_until(lambda: np.abs(arm.position - expected).max() < 0.01, 10.0)
    assert arm.motors.broken_rules == []
    # an encoder step is 1.5 mrad, and LeRobot truncates smaller changes
    wait_until(lambda: np.abs(driver.read().joints.position - expected).max() < 0.01, 5.0)


def test_nothing_is_sent_before_the_first_command(driver: LerobotDriver, arm: SerialArm) -> None:
    begun_s = time.monotonic()
    wait_until(later(begun_s, 0.5))
    assert arm.rest_after_s(begun_s) == 0.0


def test_a_hold_brakes_the_arm_and_keeps_the_grasp(driver: LerobotDriver, arm: SerialArm) -> None:
    driver.send(
        JointCommand(
            names=("shoulder_pan", "gripper"), position=np.array([1.2, 0.0]), duration_s=3.0
        )
    )
    wait_until(lambda: arm.position[0] > 0.15, 15.0)
    begun_s = time.monotonic()
    driver.hold()
    wait_until(later(begun_s, 1.0))
    assert arm.rest_after_s(begun_s) < REST_S or arm.position[0] < 0.6
    assert arm.position[0] < 0.6
    wait_until(lambda: arm.position[5] < 0.05, 15.0, "the gripper to go on closing")


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        (BusFaults(silent=True), "the motor bus so101_follower is silent: There is no status"),
        (BusFaults(wrong={"elbow_flex": 700}), "motor 'elbow_flex' reports"),
    ],
    ids=["silent", "wrong"],
)
@pytest.mark.sampled(every=2)
def test_a_bad_bus_is_a_fault_after_which_nothing_moves_by_itself(
    driver: LerobotDriver, arm: SerialArm, faults: BusFaults, words: str
) -> None:
    begun_s = turning(driver, arm)
    arm.motors.faults = faults
    wait_until(lambda: words in driver.read().detail["fault"], 3.0, "the fault to be told")
    with pytest.raises(UnsafeError, match="held by a fault"):
        turn(driver)
    wait_until(later(begun_s, 1.5))
    assert arm.rest_after_s(begun_s) < REST_S
    np.testing.assert_allclose(arm.position[1:5], SO101.home_rad[1:], atol=0.02)
    arm.motors.faults = BusFaults()
    over_s = time.monotonic()
    wait_until(later(over_s, 1.5))
    assert arm.rest_after_s(over_s) == 0.0
    wait_until(later(over_s, 2.5))
    assert driver.read().detail["fault"] == ""
    turn_until(driver, lambda: abs(arm.position[0]) < 0.01, 0.0, 0.5)


def test_the_stamp_of_a_state_grows_old_with_a_silent_bus(
    driver: LerobotDriver, arm: SerialArm
) -> None:
    arm.motors.faults = BusFaults(silent=True)
    wait_until(lambda: driver.read().detail["fault"], 3.0)
    first = driver.read().joints.stamp_ns
    begun_s = time.monotonic()
    wait_until(later(begun_s, 0.2))
    assert driver.read().joints.stamp_ns == first


def test_single_wild_readings_are_left_out(
    driver: LerobotDriver, follower: StandInFollower, arm: SerialArm
) -> None:
    turning(driver, arm)
    for _ in range(3):
        follower.good, follower.wild = 0, 2
        wait_until(lambda: follower.good > 3, 15.0, "the readings to be good again")
    assert driver.read().detail["fault"] == ""
    assert np.abs(arm.position[3] - SO101.home_rad[3]) < 0.02


def test_goals_stay_near_an_arm_that_does_not_follow(
    follower: StandInFollower, arm: SerialArm
) -> None:
    driver = LerobotDriver(
        LerobotDriverOptions(max_relative_target=2.0), so101_profile(), MemoryTopics()
    )
    driver.open()
    try:
        turn(driver, 1.2, 0.4)
        wait_until(lambda: int(driver.read().detail["clipped"]) > 5, 5.0)
        driver.hold()
        here = arm.position[0]
        begun_s = time.monotonic()
        wait_until(later(begun_s, 1.0))
        assert arm.position[0] - here < 0.3
    finally:
        driver.close()


def test_a_bound_of_lerobots_own_is_counted_too(
    driver: LerobotDriver, follower: StandInFollower, arm: SerialArm
) -> None:
    follower.cap = 0.5
    turn(driver, 1.2, 0.4)
    wait_until(lambda: int(driver.read().detail["clipped"]) > 5, 5.0)
    assert arm.position[0] < 1.0


@pytest.mark.parametrize(
    ("names", "position", "words"),
    [
        (("tail",), [0.0], "'tail' is not known"),
        (("shoulder_pan",), [np.nan], "not finite"),
        (("shoulder_pan",), [0.0, 1.0], "shape"),
    ],
)
def test_nonsense_is_refused(
    driver: LerobotDriver, names: tuple[str, ...], position: list[float], words: str
) -> None:
    with pytest.raises(InvalidInputError, match=words):
        driver.send(JointCommand(names=names, position=np.array(position), duration_s=0.5))


def test_it_is_opened_once_and_closed_often(driver: LerobotDriver, arm: SerialArm) -> None:
    with pytest.raises(StateError, match="open already"):
        driver.open()
    turning(driver, arm)
    begun_s = time.monotonic()
    driver.close()
    driver.close()
    wait_until(later(begun_s, 1.0))
    assert arm.rest_after_s(begun_s) < REST_S
    with pytest.raises(StateError, match="not open"):
        driver.read()


def test_a_bus_that_does_not_answer_and_another_calibration_are_refused(
    follower: StandInFollower, arm: SerialArm
) -> None:
    arm.motors.faults = BusFaults(silent=True)
    options = LerobotDriverOptions(port="/dev/ttyACM7")
    with pytest.raises(NotReadyError, match=r"on /dev/ttyACM7 does not answer: There is no"):
        connect(follower, options)
    arm.motors.faults = BusFaults()
    follower.is_calibrated = False
    with pytest.raises(ConfigurationError, match="hold another calibration"):
        connect(follower, options)
    assert not follower.is_connected


def test_a_lost_answer_while_it_connects_is_asked_for_again(follower: StandInFollower) -> None:
    follower.missed = 2
    connect(follower, LerobotDriverOptions())
    assert follower.is_connected
    follower.disconnect()
    follower.missed = 3
    with pytest.raises(NotReadyError, match="does not answer"):
        connect(follower, LerobotDriverOptions())
    assert not follower.is_connected


def test_a_lacking_calibration_is_refused_before_the_bus_is_opened(
    follower: StandInFollower,
) -> None:
    follower.calibration_fpath.unlink()
    driver = LerobotDriver(None, so101_profile(), MemoryTopics())
    with pytest.raises(ConfigurationError, match="There is no calibration"):
        driver.open()
    assert not follower.is_connected


@pytest.mark.parametrize(
    ("motors", "words"),
    [
        ({"tail": MotorOption()}, "motors names 'tail'"),
        ({"elbow_flex": MotorOption(joint="elbow")}, "moves the joint 'elbow', which robot"),
        ({"elbow_flex": MotorOption(unit="range")}, "in degrees, the driver expects range"),
        ({"elbow_flex": MotorOption(joint="wrist_flex")}, "joint is repeated"),
        ({"elbow_flex": MotorOption(joint="gripper", unit="degrees")}, "joint is repeated"),
    ],
)
def test_motors_that_fit_no_joint_are_refused_by_name(
    follower: StandInFollower, motors: dict[str, MotorOption], words: str
) -> None:
    options = LerobotDriverOptions(motors=motors)
    calibration = calibration_of(follower, options)
    with pytest.raises(ConfigurationError, match=words):
        map_motors(follower, options, so101_profile(), calibration)


def test_an_arm_with_a_motor_too_few_is_refused_by_the_joint(follower: StandInFollower) -> None:
    del follower.action_features["wrist_roll.pos"]
    options = LerobotDriverOptions()
    with pytest.raises(ConfigurationError, match="moves the joint 'wrist_roll'"):
        map_motors(follower, options, so101_profile(), calibration_of(follower, options))


def test_an_inverted_motor_with_an_offset_and_one_in_shares_are_mapped(
    follower: StandInFollower,
) -> None:
    follower.bus.motors["wrist_roll"] = StandInMotor(5, NormMode.RANGE_M100_100)
    options = LerobotDriverOptions(
        motors={
            "elbow_flex": MotorOption(inverted=True, offset_deg=90.0),
            "wrist_roll": MotorOption(unit="range"),
        }
    )
    motors = map_motors(follower, options, so101_profile(), calibration_of(follower, options))
    values = dict.fromkeys(motors.keys, 0.0)
    position = motors.positions(values | {"elbow_flex.pos": 30.0, "wrist_roll.pos": 100.0})
    assert position[2] == pytest.approx(np.radians(60.0))
    assert position[4] == pytest.approx(np.pi)


def test_a_class_that_fails_is_a_silent_bus(
    driver: LerobotDriver, follower: StandInFollower, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(action: dict[str, float]) -> Mapping[str, float]:
        return {"sent": action["no such motor.pos"]}

    turn(driver)
    monkeypatch.setattr(follower, "send_action", fail)
    wait_until(lambda: int(driver.read().detail["bus_errors"]) > 3, 10.0)
    monkeypatch.setattr(follower, "get_observation", partial(fail, {}))
    wait_until(lambda: "no such motor.pos" in driver.read().detail["fault"], 10.0)
