"""The driver `fci` against franka-sim, over TCP and UDP on loopback; skipped without the
simulator's environment.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fci_simulator import MARKS, PYTHON, until

from rn_robot_fr3.fci.driver import FciDriver
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.simulator import FrankaSim
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_testing.fakes import MemoryTopics
from roboneuron import JointCommand, NotReadyError, RefusedError, StateError, UnsafeError

pytestmark = MARKS
HOME = np.array(HOME_RAD)


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrankaSim]:
    with FrankaSim(
        PYTHON,
        seed=3,
        options=["--enforce-motion-limits"],
        log=tmp_path_factory.mktemp("sim") / "log",
    ) as running:
        yield running


@pytest.fixture
def driver(sim: FrankaSim) -> Iterator[FciDriver]:
    options = FciDriverOptions(
        host=sim.host, realtime="ignored", scene=sim.scene_address, watchdog_s=5.0
    )
    made = FciDriver(options, profile(), MemoryTopics())
    made.open()
    yield made
    sim.tell(mode=1)
    made.close()


def go(target: np.ndarray, duration_s: float = 0.5) -> JointCommand:
    return JointCommand(names=ARM_JOINTS, position=target, duration_s=duration_s)


def truth(sim: FrankaSim) -> np.ndarray:
    return np.array(sim.tell()["joints"][:7])


def test_it_goes_where_it_is_sent_and_tells_what_it_measures(
    driver: FciDriver, sim: FrankaSim
) -> None:
    target = HOME + 0.1
    sent = driver.send(go(target))
    assert sent.position == pytest.approx(target)
    until(driver, lambda: bool(np.abs(truth(sim) - target).max() < 1e-3))
    state = driver.read()
    assert state.joints.names[:7] == ARM_JOINTS
    assert state.detail["fault"] == ""
    assert {
        "mode",
        "torque_nm",
        "external_wrench",
        "tcp_m",
        "control_success_rate",
        "sim_time_s",
    } <= state.detail.keys()


def test_a_stream_of_targets_ends_in_a_stop_and_then_the_loop_ends(
    driver: FciDriver, sim: FrankaSim
) -> None:
    for step in range(20):
        driver.send(go(HOME + 0.15 * np.sin(0.2 * step), 0.1))
        driver.read()
        time.sleep(0.05)
    until(driver, lambda: driver.read().detail["mode"] == "Idle")
    assert np.abs(sim.tell()["velocities"]).max() < 1e-2
    assert driver.read().detail["fault"] == ""


def test_hold_stops_on_the_way(driver: FciDriver, sim: FrankaSim) -> None:
    start = truth(sim)
    driver.send(go(HOME + np.array([1.5, 0, 0, 0, 0, 0, 0]), 3.0))
    until(driver, lambda: bool(abs(truth(sim)[0] - start[0]) > 0.2))
    driver.hold()
    until(driver, lambda: driver.read().detail["mode"] == "Idle")
    assert truth(sim)[0] < 1.4


def test_hold_does_not_come_back(driver: FciDriver, sim: FrankaSim) -> None:
    driver.send(go(HOME))
    until(driver, lambda: driver.read().detail["mode"] == "Idle")
    driver.send(go(HOME + np.array([-1.5, 0, 0, 0, 0, 0, 0]), 0.5))
    until(driver, lambda: bool(sim.tell()["velocities"][0] < -0.4))
    driver.hold()
    passed = [truth(sim)[0]]
    until(driver, lambda: passed.append(truth(sim)[0]) or driver.read().detail["mode"] == "Idle")
    assert truth(sim)[0] - min(passed) < 3e-3  # at 0.4 rad/s the way back was 10 mrad


def test_a_state_that_is_lost_on_the_way_is_no_fault(driver: FciDriver, sim: FrankaSim) -> None:
    for side in (1, -1, 1, -1):
        driver.send(go(HOME + 0.3 * side, 0.1))
        until(driver, lambda: bool(np.abs(sim.tell()["velocities"]).max() > 0.2))
        sim.tell(drop=1)
        until(driver, lambda: bool(np.abs(sim.tell()["velocities"]).max() < 0.05))
    assert driver.read().detail["fault"] == ""


def test_a_control_process_that_hangs_is_a_fault_until_it_is_replaced(
    driver: FciDriver, sim: FrankaSim
) -> None:
    driver.send(go(HOME + 0.3, 2.0))
    until(driver, lambda: bool(np.abs(sim.tell()["velocities"]).max() > 0.05))
    hung = driver._arm._process.pid
    os.kill(hung, signal.SIGSTOP)
    until(driver, lambda: driver.read().detail["fault"].startswith("communication_lost"))
    with pytest.raises(UnsafeError, match="communication_lost"):
        driver.send(go(HOME))
    driver.hold()
    stamp_ns = driver.read().joints.stamp_ns
    until(driver, lambda: bool(np.abs(sim.tell()["velocities"]).max() < 0.01))
    assert driver.read().joints.stamp_ns == stamp_ns, "nothing was measured"
    stood = truth(sim)
    assert driver.recover() == "communication_lost"
    assert driver._arm._process.pid != hung
    assert np.abs(truth(sim) - stood).max() < 1e-2, "a recovery moves nothing"
    driver.send(go(HOME))
    until(driver, lambda: bool(np.abs(truth(sim) - HOME).max() < 1e-2))


def test_the_gripper_says_that_it_holds_nothing_and_opens_again(driver: FciDriver) -> None:
    driver.send(JointCommand(names=(FINGER_JOINT,), position=np.array([0.0]), duration_s=0.5))
    until(driver, lambda: driver.read().detail["gripper"] == "nothing grasped")
    driver.send(JointCommand(names=(FINGER_JOINT,), position=np.array([0.04]), duration_s=0.5))
    until(driver, lambda: driver.read().detail["gripper"] == "at 80 mm")
    assert driver.read().gripper_open == pytest.approx(1.0, abs=0.02)


def test_the_user_stop_is_a_fault_that_stands_until_it_is_released(
    driver: FciDriver, sim: FrankaSim
) -> None:
    driver.send(go(HOME + 0.3, 2.0))
    until(driver, lambda: bool(np.abs(sim.tell()["velocities"]).max() > 0.05))
    sim.tell(mode=5)
    until(driver, lambda: driver.read().detail["fault"].startswith("user_stop"))
    with pytest.raises(UnsafeError, match="user_stop"):
        driver.send(go(HOME))
    with pytest.raises(RefusedError, match="Release"):
        driver.recover()
    sim.tell(mode=1)
    until(driver, lambda: driver.read().detail["mode"] == "Idle")
    with pytest.raises(UnsafeError):
        driver.send(go(HOME))
    assert driver.recover() == "user_stop"
    driver.send(go(HOME))
    until(driver, lambda: bool(np.abs(truth(sim) - HOME).max() < 1e-2))


def test_a_reflex_is_a_fault_that_a_person_recovers(driver: FciDriver, sim: FrankaSim) -> None:
    with pytest.raises(StateError, match="no fault"):
        driver.recover()
    driver.send(go(HOME + 0.3, 2.0))
    time.sleep(0.1)
    sim.tell(error=21)
    until(driver, lambda: driver.read().detail["fault"] != "")
    assert driver.read().detail["mode"] == "Reflex"
    driver.recover()
    assert driver.read().detail["fault"] == "" or not until(
        driver, lambda: driver.read().detail["fault"] == ""
    )


def test_a_module_that_asks_for_nothing_is_stopped(sim: FrankaSim) -> None:
    options = FciDriverOptions(host=sim.host, realtime="ignored", watchdog_s=0.2, gripper=False)
    driver = FciDriver(options, profile(), MemoryTopics())
    driver.open()
    try:
        driver.send(go(HOME + np.array([-1.0, 0, 0, 0, 0, 0, 0]), 5.0))
        time.sleep(2.0)
        assert int(driver.read().detail["watchdog_stops"]) >= 1
        assert np.abs(sim.tell()["velocities"]).max() < 1e-2
    finally:
        driver.close()


def test_a_second_client_is_told_so(driver: FciDriver, sim: FrankaSim) -> None:
    options = FciDriverOptions(
        host=sim.host, realtime="ignored", connect_timeout_s=1.0, gripper=False
    )
    second = FciDriver(options, profile(), MemoryTopics())
    with pytest.raises(NotReadyError, match="Another client"):
        second.open()


def test_an_ordinary_kernel_is_refused_unless_it_is_ignored(sim: FrankaSim) -> None:
    if Path("/sys/kernel/realtime").exists():
        pytest.skip("this kernel is real-time")
    strict = FciDriver(FciDriverOptions(host=sim.host, gripper=False), profile(), MemoryTopics())
    with pytest.raises(Exception, match="PREEMPT_RT"):
        strict.open()
