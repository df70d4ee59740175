"""The driver's thread, its commands and its topic, with topics in memory."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import numpy as np
import pytest
from pydantic import ValidationError
from std_msgs.msg import Float64MultiArray

from rn_robot_fr3.cell import FR3
from rn_robot_fr3.driver import SimulatedFr3Driver
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.options import SimulatedFr3Options
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_simulation.engine import Engine
from rn_simulation.ground_truth import SWITCH
from rn_simulation.scene_state import TOPIC, from_message, to_message
from rn_testing.fakes import MemoryTopics, gantry_profile
from rn_testing.waiting import wait_until
from roboneuron.contract import JointCommand
from roboneuron.errors import ConfigurationError, InvalidInputError, StateError

COUNTS = {FR3.robot: len(FR3.joints)}


@pytest.fixture
def topics() -> MemoryTopics:
    return MemoryTopics()


@pytest.fixture
def driver(engine: Engine, topics: MemoryTopics) -> Iterator[SimulatedFr3Driver]:
    driver = SimulatedFr3Driver(SimulatedFr3Options(seed=5, engine=engine), profile(), topics)
    driver.open()
    yield driver
    driver.close()


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "on")


def test_the_truth_is_not_reported_unless_it_is_asked_for(driver: SimulatedFr3Driver) -> None:
    assert driver.read().detail.keys() == {"sim_time_s", "real_time_factor", "engine"}


@pytest.mark.usefixtures("told")
def test_state_starts_at_home_with_an_open_gripper(
    engine: Engine, driver: SimulatedFr3Driver
) -> None:
    state = driver.read()
    assert state.joints.names[:7] == ARM_JOINTS
    np.testing.assert_allclose(state.joints.position[:7], HOME_RAD, atol=1e-3)
    assert state.joints.velocity is not None
    assert state.gripper_open == pytest.approx(1.0, abs=0.01)
    cubes = json.loads(state.detail["cubes"])
    assert set(cubes) == {"red", "green", "blue", "yellow"}
    assert cubes["red"]["lifted_m"] == pytest.approx(0.0, abs=1e-3)
    assert state.detail["seed"] == "5"
    assert state.detail["engine"] == engine


def test_command_moves_the_named_joints_and_is_returned_as_sent(driver: SimulatedFr3Driver) -> None:
    command = JointCommand(
        names=("fr3_joint7", FINGER_JOINT),
        position=np.array([1.0, 0.01]),
        duration_s=0.01,
        residual_m=1e-5,
    )
    sent = driver.send(command)
    assert sent.names == command.names
    assert sent.duration_s > 0.1
    assert sent.residual_m == 1e-5
    wait_until(lambda: abs(driver.read().joints.position[6] - 1.0) < 2e-3)
    wait_until(lambda: abs((driver.read().gripper_open or 0.0) - 0.25) < 0.02)


def test_simulated_time_keeps_up_with_the_wall_clock(driver: SimulatedFr3Driver) -> None:
    wait_until(lambda: float(driver.read().detail["sim_time_s"]) > 2.2)
    # Loose: the machine may be busy. Racing ahead would show as a factor over 1.
    assert 0.02 < float(driver.read().detail["real_time_factor"]) < 1.05


def test_real_time_factor_speeds_up_the_simulation(topics: MemoryTopics) -> None:
    driver = SimulatedFr3Driver(
        SimulatedFr3Options(real_time_factor=3.0, colours=("red",)), profile(), topics
    )
    driver.open()
    started_s = time.monotonic()
    wait_until(lambda: float(driver.read().detail["sim_time_s"]) > 3.0)
    elapsed_s = time.monotonic() - started_s
    if elapsed_s > 3.0:  # the machine was busy: search for one second in which it was not
        wait_until(lambda: float(driver.read().detail["real_time_factor"]) > 1.5, 60.0)
    driver.close()
    assert elapsed_s > 0.9


def test_hold_stops_the_arm(driver: SimulatedFr3Driver) -> None:
    driver.send(JointCommand(names=("fr3_joint1",), position=np.array([2.0]), duration_s=1.0))
    wait_until(lambda: driver.read().joints.position[0] > 0.3)
    driver.hold()
    wait_until(lambda: abs(driver.read().joints.velocity[0]) < 1e-3)  # type: ignore[index]
    assert driver.read().joints.position[0] < 1.5


@pytest.mark.parametrize(("name", "value"), [("fr3_joint8", 0.0), ("fr3_joint1", float("nan"))])
def test_wrong_name_and_nan_are_refused(
    driver: SimulatedFr3Driver, name: str, value: float
) -> None:
    with pytest.raises(InvalidInputError, match=name):
        driver.send(JointCommand(names=(name,), position=np.array([value]), duration_s=0.1))


def test_states_are_published_in_order_with_stamps(
    driver: SimulatedFr3Driver, topics: MemoryTopics
) -> None:
    wait_until(lambda: len(topics.published(TOPIC)) > 20)
    states = [
        from_message(m, COUNTS) for m in topics.published(TOPIC) if isinstance(m, Float64MultiArray)
    ]
    stamps = [state.stamp_ns for state in states]
    assert stamps == sorted(stamps)
    assert abs(states[-1].stamp_ns - time.time_ns()) < 5e9
    assert {name for name, _ in states[0].cubes} == {"red", "green", "blue", "yellow"}
    assert states[0].cube_poses.shape == (4, 7)


def test_driver_can_be_closed_twice_and_opened_again(topics: MemoryTopics) -> None:
    driver = SimulatedFr3Driver(SimulatedFr3Options(colours=("red",)), profile(), topics)
    driver.close()
    for _ in range(2):
        driver.open()
        with pytest.raises(StateError, match="already"):
            driver.open()
        driver.close()
        driver.close()
        with pytest.raises(StateError, match="not open"):
            driver.read()


@pytest.mark.parametrize("display", [None, ":4711"])
def test_window_without_a_display_is_refused(
    engine: Engine, topics: MemoryTopics, monkeypatch: pytest.MonkeyPatch, display: str | None
) -> None:
    if display is None:
        monkeypatch.delenv("DISPLAY", raising=False)
    else:
        monkeypatch.setenv("DISPLAY", display)
    driver = SimulatedFr3Driver(SimulatedFr3Options(gui=True, engine=engine), profile(), topics)
    with pytest.raises(ConfigurationError, match="gui = false"):
        driver.open()
    driver.close()


def test_profile_of_another_robot_is_refused(topics: MemoryTopics) -> None:
    with pytest.raises(ConfigurationError, match="gantry"):
        SimulatedFr3Driver(None, gantry_profile(), topics).open()


@pytest.mark.parametrize(
    "options", [{"colours": ["mauve"]}, {"seed": -1}, {"real_time_factor": 0}, {"sead": 1}]
)
def test_senseless_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SimulatedFr3Options.model_validate(options)


def test_message_that_is_no_scene_is_refused(
    driver: SimulatedFr3Driver, topics: MemoryTopics
) -> None:
    with pytest.raises(InvalidInputError, match="does not describe"):
        from_message(Float64MultiArray(), COUNTS)
    message = topics.published(TOPIC)[0]
    assert isinstance(message, Float64MultiArray)
    short = to_message(from_message(message, COUNTS))
    short.data = list(short.data)[:-1]
    with pytest.raises(InvalidInputError, match="values"):
        from_message(short, COUNTS)
