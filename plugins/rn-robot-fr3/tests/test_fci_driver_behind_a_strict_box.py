"""The driver `fci` behind a control box that loses packets, refuses and checks; with franka-sim,
skipped without it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fci_box.control_box import ControlBox
from fci_simulator import MARKS, PYTHON, until

from rn_robot_fr3.fci.addresses import free_address
from rn_robot_fr3.fci.driver import FciDriver
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.simulator import FrankaSim
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_testing.fakes import MemoryTopics
from roboneuron import JointCommand, RefusedError, UnsafeError

pytestmark = MARKS
HOME = np.array(HOME_RAD)
FAULTLESS = {"loss": 0.0, "duplicate": 0.0, "reorder": 0.0, "delay": 0.0}
OTHER, IDLE, GUIDING, USER_STOPPED = 0, 1, 3, 5


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrankaSim]:
    log = tmp_path_factory.mktemp("sim") / "log"
    options = ["--enforce-comm-constraints", "--no-gripper"]
    with FrankaSim(PYTHON, seed=3, options=options, log=log) as running:
        yield running


@pytest.fixture(scope="module")
def box(sim: FrankaSim, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlBox]:
    log = tmp_path_factory.mktemp("box") / "log"
    with ControlBox(free_address(1337, 1340), sim.host, log) as running:
        yield running


@pytest.fixture
def driver(sim: FrankaSim, box: ControlBox) -> Iterator[FciDriver]:
    box.tell(fresh=1, latched=0, lenient=0, **FAULTLESS)
    options = FciDriverOptions(
        host=box.host, realtime="ignored", gripper=False, watchdog_s=5.0, dynamics_factor=0.5
    )
    made = FciDriver(options, profile(), MemoryTopics())
    made.open()
    yield made
    box.tell(latched=0, lenient=0, **FAULTLESS)
    sim.tell(mode=IDLE)
    made.close()


def fault(driver: FciDriver) -> str:
    return driver.read().detail["fault"]


def is_moving(sim: FrankaSim) -> bool:
    return bool(np.abs(sim.tell()["velocities"]).max() > 0.1)


def go(driver: FciDriver, target: np.ndarray, duration_s: float = 0.1) -> None:
    driver.send(JointCommand(names=ARM_JOINTS, position=target, duration_s=duration_s))


def streamed(driver: FciDriver, targets: int) -> None:
    """Send targets at 20 Hz, with an occasional stop."""
    dice, at = np.random.default_rng(5), HOME
    for number in range(1, targets + 1):
        at = np.clip(at + dice.uniform(-0.08, 0.08, 7), HOME - 0.4, HOME + 0.4)
        go(driver, at)
        if number % 30 == 0:
            driver.hold()
        driver.read()
        time.sleep(0.05)


@pytest.mark.parametrize(
    "faults",
    [
        {"loss": 0.01},
        {"loss": 0.05},
        {"loss": 0.2},
        {"duplicate": 0.1, "reorder": 0.05},
        {"loss": 0.05, "duplicate": 0.05, "reorder": 0.05, "delay": 0.05},
    ],
)
def test_no_command_is_beyond_a_limit_on_a_bad_cable(
    driver: FciDriver, box: ControlBox, faults: dict[str, float]
) -> None:
    box.tell(fresh=1, **{**FAULTLESS, **faults})
    streamed(driver, 80)
    seen = box.tell()
    assert seen["beyond"] == []
    assert seen["repeated"] == 0, "no number twice"
    assert seen["commands"] > 1000
    assert fault(driver) == ""


@pytest.mark.parametrize("silence", [4, 9, 14, 18])
def test_a_silence_of_the_states_makes_no_jump(
    driver: FciDriver, box: ControlBox, sim: FrankaSim, silence: int
) -> None:
    for side in (1, -1):
        go(driver, HOME + 0.3 * side)
        until(driver, lambda: is_moving(sim))
        box.tell(silence=silence)
        until(driver, lambda: not is_moving(sim))
    seen = box.tell()
    assert seen["beyond"] == []
    assert seen["longest_gap"] >= silence
    assert fault(driver) == ""


def test_a_cable_that_delays_everything_ends_in_a_named_stop(
    driver: FciDriver, box: ControlBox, sim: FrankaSim
) -> None:
    go(driver, HOME + 0.3)
    until(driver, lambda: is_moving(sim))
    box.tell(delay=1.0, delay_s=0.002)
    until(driver, lambda: fault(driver).startswith("communication_lost"))
    assert box.tell()["beyond"] == []


def test_settings_refused_until_a_recovery_are_made_after_it(
    sim: FrankaSim, box: ControlBox
) -> None:
    box.tell(latched=1)
    options = FciDriverOptions(host=box.host, realtime="ignored", gripper=False)
    driver = FciDriver(options, profile(), MemoryTopics())
    driver.open()
    try:
        assert fault(driver).startswith("settings_refused")
        with pytest.raises(UnsafeError, match="settings_refused"):
            go(driver, HOME)
        driver.close()
        driver.open()
        assert fault(driver).startswith("settings_refused"), "stop and start work, and hide nothing"
        assert driver.recover() == "settings_refused"
        before = np.array(sim.tell()["joints"][:7])
        assert fault(driver) == ""
        assert np.abs(np.array(sim.tell()["joints"][:7]) - before).max() < 1e-3
        go(driver, HOME + 0.05)
        until(
            driver,
            lambda: bool(np.abs(np.array(sim.tell()["joints"][:7]) - HOME - 0.05).max() < 1e-2),
        )
    finally:
        driver.close()


@pytest.mark.parametrize(
    ("mode", "code", "says"),
    [
        (USER_STOPPED, "user_stop", "Release"),
        (GUIDING, "guiding", "Let go"),
        (OTHER, "brakes_locked", "unlock the joints"),
    ],
)
def test_a_mode_is_told_in_its_own_words_however_often_a_recovery_is_tried(
    driver: FciDriver, sim: FrankaSim, mode: int, code: str, says: str
) -> None:
    go(driver, HOME + 0.2)
    until(driver, lambda: is_moving(sim))
    sim.tell(mode=mode)
    until(driver, lambda: fault(driver).startswith(code))
    told = fault(driver)
    for _ in range(3):
        with pytest.raises(RefusedError, match=says):
            driver.recover()
    assert fault(driver) == told, "it doesn't grow"
    sim.tell(mode=IDLE)
    until(driver, lambda: driver.read().detail["mode"] == "Idle")
    before = np.array(sim.tell()["joints"][:7])
    driver.recover()
    for _ in range(20):
        driver.read()
        time.sleep(0.01)  # to show that nothing happens
    assert np.abs(np.array(sim.tell()["joints"][:7]) - before).max() < 1e-3, (
        "a recovery moves nothing"
    )


def test_a_driver_starts_while_the_brakes_are_closed_and_recovers_afterwards(
    sim: FrankaSim, box: ControlBox
) -> None:
    sim.tell(mode=OTHER)
    driver = FciDriver(
        FciDriverOptions(host=box.host, realtime="ignored", gripper=False),
        profile(),
        MemoryTopics(),
    )
    try:
        driver.open()
        assert fault(driver).startswith("brakes_locked")
        sim.tell(mode=IDLE)
        until(driver, lambda: driver.read().detail["mode"] == "Idle")
        assert driver.recover() == "brakes_locked"
    finally:
        sim.tell(mode=IDLE)
        driver.close()


def test_a_reflex_is_recovered_before_settings_are_made(
    driver: FciDriver, sim: FrankaSim, box: ControlBox
) -> None:
    go(driver, HOME - 0.3, 2.0)
    until(driver, lambda: is_moving(sim))
    box.tell(latched=1)
    sim.tell(error=21)
    until(driver, lambda: fault(driver) != "")
    driver.recover()
    assert fault(driver) == ""
    go(driver, HOME)
    until(driver, lambda: bool(np.abs(np.array(sim.tell()["joints"][:7]) - HOME).max() < 1e-2))


def test_two_simulators_run_side_by_side(sim: FrankaSim, tmp_path: Path) -> None:
    with FrankaSim(PYTHON, seed=4, options=["--no-gripper"], log=tmp_path / "log") as second:
        assert second.host != sim.host
        assert (second.tell()["seed"], sim.tell()["seed"]) == (4, 3)
