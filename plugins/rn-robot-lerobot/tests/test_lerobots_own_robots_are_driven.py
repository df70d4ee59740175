"""The driver `lerobot` in lerobot's environment with lerobot's own classes: the Koch and the SO-101
follower with motors that use the real protocols, and a third party's robot.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from own_robots import NEEDED, PROCESS, Cell, DriverError, Process, process_with

from rn_robot_lerobot.bus.arm import SERIAL_KOCH, SERIAL_SO101
from rn_robot_lerobot.bus.chain import BusFaults
from rn_robot_lerobot.bus.dynamixel_motors import ALERT, DynamixelChain
from rn_robot_lerobot.bus.reference import ASSEMBLED_KOCH
from rn_robot_lerobot.calibration import MotorCalibration
from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(180),
    NEEDED,
]
REST_S = 0.5
"""From a fault to an arm at rest: the silence that counts as a fault, and the remaining motion to
the last goal. The fault matrix allows `command_timeout_s`.
"""
THIRD = {
    "type": "thirdarm",
    "motors": {
        "j1": {"joint": "shoulder_pan", "unit": "radians"},
        "j2": {"joint": "shoulder_lift", "unit": "radians", "inverted": True, "offset_deg": 10.0},
        "j3": {"joint": "elbow_flex", "unit": "radians"},
        "j4": {"joint": "wrist_flex", "unit": "radians"},
        "j5": {"joint": "wrist_roll", "unit": "radians"},
        "claw": {"joint": "gripper", "inverted": True},
    },
}


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    log = tmp_path_factory.mktemp("lerobot") / "driver.log"
    with process_with(log, PROCESS / "third_party") as process:
        yield process


@pytest.fixture
def driver(process: Process) -> Iterator[Process]:
    """The process, whose driver is closed at the end."""
    yield process
    with suppress(DriverError):
        process("close")


@pytest.fixture(params=[SERIAL_KOCH, SERIAL_SO101], ids=["koch", "so101"])
def cell(request: pytest.FixtureRequest, tmp_path: Path, driver: Process) -> Iterator[Cell]:
    with ExitStack() as stack:
        cell = Cell(request.param, tmp_path, driver, stack)
        yield cell
        with suppress(DriverError):
            driver("close")  # before its port is gone


@pytest.fixture
def koch_cell(tmp_path: Path, driver: Process) -> Iterator[Cell]:
    with ExitStack() as stack:
        cell = Cell(SERIAL_KOCH, tmp_path, driver, stack)
        yield cell
        with suppress(DriverError):
            driver("close")


def later(since_s: float, seconds: float) -> Callable[[], bool]:
    return lambda: time.monotonic() > since_s + seconds


def test_it_reads_the_joints_and_moves_them_where_it_is_sent(cell: Cell) -> None:
    cell.driver("open")
    state = cell.driver("read")
    measured = [*state["joints"].values()]
    np.testing.assert_allclose(measured[:5], cell.home_rad, atol=0.01)
    assert state["gripper_open"] == pytest.approx(1.0, abs=0.01)
    target = {"shoulder_pan": 0.4, "shoulder_lift": -0.2, "wrist_roll": -0.5, "gripper": 0.6}
    cell.driver("send", target, 0.5)
    expected = [0.4, -0.2, *cell.home_rad[2:4], -0.5, 0.6]
    wait_until(lambda: np.abs(cell.arm.position - expected).max() < 0.01, 20.0)
    wait_until(
        lambda: np.abs(np.array([*cell.driver("read")["joints"].values()]) - expected).max() < 0.01,
        10.0,
    )
    assert cell.arm.motors.broken_rules == []
    assert cell.driver.fault() == ""


def test_a_hold_brakes_the_arm_and_a_closed_driver_leaves_it_at_rest(cell: Cell) -> None:
    cell.driver("open")
    begun_s = cell.turn()
    cell.driver("hold")
    wait_until(later(begun_s, 1.5))
    assert cell.arm.rest_after_s(begun_s) < REST_S
    assert cell.arm.position[0] < 0.7
    begun_s = cell.turn()
    cell.driver("close")
    wait_until(later(begun_s, 1.5))
    assert cell.arm.rest_after_s(begun_s) < REST_S
    assert cell.arm.motors.goals()[1].all(), "the arm has fallen down"


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        (BusFaults(silent=True), "is silent: "),
        (BusFaults(wrong={"elbow_flex": 700}), "motor 'elbow_flex' reports"),
    ],
    ids=["silent", "wrong"],
)
def test_a_bad_bus_is_a_fault_after_which_nothing_moves_by_itself(
    cell: Cell, faults: BusFaults, words: str
) -> None:
    cell.driver("open")
    begun_s = cell.turn()
    cell.arm.motors.faults = faults
    wait_until(lambda: words in cell.driver.fault(), 10.0, "the fault to be told")
    with pytest.raises(DriverError, match="UnsafeError: The arm is held by a fault"):
        cell.driver("send", {"shoulder_pan": 0.0}, 1.0)
    wait_until(later(begun_s, 2.0))
    assert cell.arm.rest_after_s(begun_s) < REST_S
    cell.arm.motors.faults = BusFaults()
    over_s = time.monotonic()
    wait_until(later(over_s, 1.5))
    assert cell.arm.rest_after_s(over_s) == 0.0
    wait_until(lambda: cell.driver.fault() == "", 20.0)

    def is_back() -> bool:
        with suppress(DriverError):  # a busy machine may be silent too, so it is retried
            cell.driver("send", {"shoulder_pan": 0.0}, 1.0)
        return bool(abs(cell.arm.position[0]) < 0.01)

    wait_until(is_back, 20.0, poll_s=0.2)


def test_lost_and_late_packets_do_not_keep_it_from_arriving(koch_cell: Cell) -> None:
    koch_cell.driver("open")
    koch_cell.arm.motors.faults = BusFaults(lost_share=0.02, answer_delay_s=0.002)
    koch_cell.driver("send", {"shoulder_pan": 0.5}, 1.0)
    wait_until(lambda: abs(koch_cell.arm.position[0] - 0.5) < 0.01, 20.0)
    assert koch_cell.arm.motors.broken_rules == []


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        (None, r"There is no calibration .*koch\.json\. Make it with: lerobot-calibrate"),
        ({"tail": ASSEMBLED_KOCH.calibration()["gripper"]}, "names the unknown motor 'tail'"),
        (
            {"elbow_flex": replace(ASSEMBLED_KOCH.calibration()["elbow_flex"], homing_offset=17)},
            "hold another calibration than",
        ),
    ],
    ids=["missing", "unknown", "another"],
)
def test_what_is_wrong_with_a_calibration_is_one_sentence_and_nothing_moves(
    koch_cell: Cell, calibration: dict[str, MotorCalibration] | None, words: str
) -> None:
    if calibration is None:
        (koch_cell.folder / "koch.json").unlink()
    else:
        koch_cell.write_calibration({**ASSEMBLED_KOCH.calibration(), **calibration})
    begun_s = time.monotonic()
    with pytest.raises(DriverError, match=f"ConfigurationError: .*{words}"):
        koch_cell.driver("open")
    assert koch_cell.arm.rest_after_s(begun_s) == 0.0


def test_a_motor_that_is_mounted_the_other_way_round_is_another_calibration(
    koch_cell: Cell,
) -> None:
    motors = koch_cell.arm.motors
    assert isinstance(motors, DynamixelChain)
    motors.invert("elbow_flex")
    with pytest.raises(DriverError, match=r"ConfigurationError: .*hold another calibration"):
        koch_cell.driver("open")


@pytest.mark.parametrize(
    ("faults", "model"),
    [(BusFaults(silent=True), 1200), (BusFaults(error=ALERT), 1200), (BusFaults(), 1190)],
    ids=["silent", "alert", "model"],
)
def test_a_bus_that_is_not_the_arms_is_refused_in_one_sentence(
    koch_cell: Cell, faults: BusFaults, model: int
) -> None:
    motors = koch_cell.arm.motors
    motors.faults = faults
    motors.memories[2][0:2] = model.to_bytes(2, "little")
    with pytest.raises(DriverError, match=r"NotReadyError: LeRobot's 'koch_follower' on /dev/pts/"):
        koch_cell.driver("open")
    motors.faults = BusFaults()
    assert not motors.goals()[1].any(), "a motor has torque"


def test_a_version_that_the_driver_is_not_written_for_is_refused(tmp_path: Path) -> None:
    info = tmp_path / "lerobot-0.5.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot\nVersion: 0.5.1\n")
    with process_with(tmp_path / "driver.log", tmp_path) as driver:
        driver("new", "koch", {"port": "/dev/null"})
        with pytest.raises(DriverError, match=r"lerobot is 0\.5\.1; .*pip install"):
            driver("open")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"type": "kooch"}, "LeRobot has no robot 'kooch'; it has .*koch_follower"),
        ({"settings": {"speed": 3}}, "has no setting 'speed'; it has .*use_degrees"),
        ({"motors": {"elbow": {}}}, "names 'elbow'; the robot has shoulder_pan"),
        ({"motors": {"elbow_flex": {"unit": "degrees"}}}, "in range, the driver expects degrees"),
    ],
    ids=["type", "setting", "motor", "unit"],
)
def test_options_that_lerobot_does_not_know_are_refused_by_name(
    tmp_path: Path, driver: Process, options: dict[str, object], words: str
) -> None:
    text = json.dumps({name: asdict(motor) for name, motor in ASSEMBLED_KOCH.calibration().items()})
    (tmp_path / "koch.json").write_text(text, encoding="utf-8")
    driver("new", "koch", {"port": "/dev/null", "calibration_dir": str(tmp_path), **options})
    with pytest.raises(DriverError, match=f"ConfigurationError: .*{words}"):
        driver("open")


def test_a_robot_of_a_third_party_moves_by_its_name(tmp_path: Path, driver: Process) -> None:
    driver("new", "so101", {**THIRD, "calibration_dir": str(tmp_path)})
    driver("open")
    state = driver("read")
    assert state["joints"]["shoulder_lift"] == pytest.approx(np.radians(10.0))
    assert state["gripper_open"] == pytest.approx(1.0)
    target = {"shoulder_pan": 0.3, "shoulder_lift": 0.1, "gripper": -0.174533}
    driver("send", target, 0.5)

    def is_there() -> bool:
        joints = driver("read")["joints"]
        return all(abs(joints[name] - value) < 1e-3 for name, value in target.items())

    wait_until(is_there, 20.0)
    assert driver("read")["gripper_open"] == pytest.approx(0.0, abs=1e-3)


def test_a_joint_that_a_third_partys_robot_lacks_is_named(tmp_path: Path, driver: Process) -> None:
    driver("new", "so101", {"type": "thirdarm", "calibration_dir": str(tmp_path)})
    with pytest.raises(DriverError, match="Motor 'j1' moves the joint 'j1', which robot 'so101'"):
        driver("open")


@pytest.mark.parametrize(
    ("forgets", "words"),
    [("", "the arm was unplugged"), ("j3.pos", "The robot does not report j3.pos.")],
    ids=["fails", "forgets"],
)
def test_a_third_partys_robot_that_fails_is_a_silent_bus(
    tmp_path: Path, driver: Process, forgets: str, words: str
) -> None:
    settings = {"fails_after": 20, "forgets": forgets}
    driver("new", "so101", {**THIRD, "calibration_dir": str(tmp_path), "settings": settings})
    driver("open")
    fault = f"the motor bus thirdarm is silent: {words}"
    wait_until(lambda: driver.fault() == fault, 10.0)
    with pytest.raises(DriverError, match="held by a fault"):
        driver("send", {"shoulder_pan": 0.3}, 0.5)
