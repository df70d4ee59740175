"""The driver's thread, its topics and its refusals, with topics in memory."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from pydantic import ValidationError

from rn_robot_bases.driver import SimulatedBase
from rn_robot_bases.options import SimulatedBaseOptions
from rn_robot_bases.platform import PLATFORMS
from rn_robot_bases.profile import diffdrive_profile, husky_profile, racecar_profile
from rn_simulation.ground_truth import SWITCH, TRUE_POSE_TOPIC
from rn_testing.fakes import MemoryTopics, gantry_profile
from rn_testing.waiting import wait_until
from roboneuron.contract import JointCommand, RobotProfile
from roboneuron.errors import ConfigurationError, InvalidInputError, StateError

CMD_VEL, ODOMETRY = "cmd_vel", "odom"

PROFILES = (diffdrive_profile, husky_profile, racecar_profile)


def twist(linear: float = 0.0, angular: float = 0.0, *, sideways: float = 0.0) -> Twist:
    message = Twist()
    message.linear.x, message.linear.y, message.angular.z = (
        float(linear),
        float(sideways),
        float(angular),
    )
    return message


@pytest.fixture(autouse=True)
def truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers report the ground truth, which these tests use."""
    monkeypatch.setenv(SWITCH, "on")


def test_the_true_pose_is_reported_only_where_it_is_asked_for(
    car: SimulatedBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "true_pose" in car.read().detail
    monkeypatch.delenv(SWITCH)
    assert "true_pose" not in car.read().detail
    assert "odometry" in car.read().detail


@pytest.fixture
def topics() -> MemoryTopics:
    return MemoryTopics()


@pytest.fixture
def car(topics: MemoryTopics) -> Iterator[SimulatedBase]:
    driver = SimulatedBase(SimulatedBaseOptions(), racecar_profile(), topics)
    driver.open()
    yield driver
    driver.close()


def detail(driver: SimulatedBase, key: str) -> str:
    return driver.read().detail[key]


@pytest.mark.parametrize("profile", PROFILES)
def test_base_drives_while_commanded_and_stops_by_itself(
    profile: Callable[[], RobotProfile], topics: MemoryTopics
) -> None:
    driver = SimulatedBase(SimulatedBaseOptions(command_timeout_s=0.3), profile(), topics)
    driver.open()

    def has_moved() -> bool:
        topics.deliver(CMD_VEL, twist(0.5, 0.2))
        return float(json.loads(detail(driver, "true_pose"))["x_m"]) > 0.2

    wait_until(has_moved)
    assert detail(driver, "motion") == "driving"
    wait_until(lambda: detail(driver, "motion") == "stopping: no command for 0.3 s")
    wait_until(lambda: bool(np.abs(driver.read().joints.velocity).max() < 0.05))  # type: ignore[arg-type]
    driver.close()
    odometry = [m for m in topics.published(ODOMETRY) if isinstance(m, Odometry)]
    assert odometry[0].header.frame_id == "odom"
    assert odometry[0].child_frame_id == profile().base_link
    assert odometry[-1].pose.pose.position.x > 0.2
    assert odometry[-1].pose.pose.orientation.z > 0.0
    true = [m for m in topics.published(TRUE_POSE_TOPIC) if isinstance(m, Odometry)]
    assert len(true) == len(odometry)
    assert true[-1].pose.pose.position.x > 0.2
    assert any(t.pose != m.pose for t, m in zip(true, odometry, strict=True))  # odometry drifts
    stamps_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in odometry]
    assert stamps_ns == sorted(stamps_ns)


def test_state_names_every_wheel_and_hinge(car: SimulatedBase) -> None:
    state = car.read()
    assert state.joints.names == PLATFORMS["racecar"].joints
    assert np.isfinite(state.joints.position).all()
    assert state.gripper_open is None
    assert json.loads(state.detail["odometry"]) == {"x_m": 0.0, "y_m": 0.0, "yaw_rad": 0.0}


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (twist(0.0, 0.5), "cannot turn on the spot"),
        (twist(5.0), "linear.x is 5"),
        (twist(0.5, sideways=0.1), "linear.y is 0.1, expected 0"),
        (twist(math.nan), "linear.x is nan"),
        (twist(0.5, -math.inf), "angular.z is -inf"),
    ],
)
def test_refused_command_stops_the_base_and_is_reported(
    car: SimulatedBase, topics: MemoryTopics, message: Twist, reason: str
) -> None:
    topics.deliver(CMD_VEL, twist(0.5, 0.2))
    wait_until(lambda: detail(car, "motion") == "driving")
    topics.deliver(CMD_VEL, message)
    wait_until(lambda: detail(car, "motion") == "stopping: a command was refused")
    assert reason in detail(car, "refused")
    assert detail(car, "refused_count") == "1"
    topics.deliver(CMD_VEL, twist(0.5, 0.2))
    wait_until(lambda: detail(car, "motion") == "driving")
    assert detail(car, "refused") == ""


def test_hold_brakes_before_the_deadman_would(car: SimulatedBase, topics: MemoryTopics) -> None:
    def is_fast() -> bool:
        topics.deliver(CMD_VEL, twist(1.0))
        return float(json.loads(detail(car, "odometry"))["x_m"]) > 0.5

    wait_until(is_fast)
    car.hold()
    wait_until(lambda: detail(car, "motion") == "stopping: held")
    wait_until(lambda: bool(np.abs(car.read().joints.velocity).max() < 0.1))  # type: ignore[arg-type]


def test_joint_command_is_refused(car: SimulatedBase) -> None:
    command = JointCommand(names=("left_wheel",), position=np.array([1.0]), duration_s=1.0)
    with pytest.raises(InvalidInputError, match="mobile base is driven by cmd_vel"):
        car.send(command)


def test_simulated_time_keeps_up_with_the_wall_clock(car: SimulatedBase) -> None:
    started_s, sim_s = time.monotonic(), float(detail(car, "sim_time_s"))
    wait_until(lambda: float(detail(car, "sim_time_s")) > sim_s + 1.0)
    # Loose above: the machine may be busy. Racing ahead is what must not happen.
    assert 0.7 < time.monotonic() - started_s < 10.0


@pytest.mark.parametrize("profile", PROFILES)
def test_driver_can_be_closed_twice_and_opened_again(
    profile: Callable[[], RobotProfile], topics: MemoryTopics
) -> None:
    driver = SimulatedBase(None, profile(), topics)
    driver.close()
    threads = set(threading.enumerate())
    for _ in range(2):
        driver.open()
        with pytest.raises(StateError, match="already"):
            driver.open()
        driver.close()
        driver.close()
        with pytest.raises(StateError, match="not open"):
            driver.hold()
        topics.deliver(CMD_VEL, twist(0.1))
    assert set(threading.enumerate()) <= threads
    assert topics.used == (CMD_VEL, ODOMETRY, TRUE_POSE_TOPIC)


def test_two_bases_move_independently() -> None:
    worlds = [MemoryTopics(), MemoryTopics()]
    bases = [
        SimulatedBase(None, profile(), t) for profile, t in zip(PROFILES, worlds, strict=False)
    ]
    for base in bases:
        base.open()

    def first_has_moved() -> bool:
        worlds[0].deliver(CMD_VEL, twist(0.4))
        return float(json.loads(detail(bases[0], "true_pose"))["x_m"]) > 0.1

    wait_until(first_has_moved)
    assert abs(json.loads(detail(bases[1], "true_pose"))["x_m"]) < 1e-3
    for base in bases:
        base.close()


def test_profile_of_another_robot_is_refused(topics: MemoryTopics) -> None:
    with pytest.raises(ConfigurationError, match="'gantry'"):
        SimulatedBase(None, gantry_profile(), topics).open()


@pytest.mark.parametrize(
    "options", [{"command_timeout_s": 0}, {"odometry_rate_hz": 1e4}, {"comand_timeout_s": 1}]
)
def test_senseless_options_of_a_base_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SimulatedBaseOptions.model_validate(options)
