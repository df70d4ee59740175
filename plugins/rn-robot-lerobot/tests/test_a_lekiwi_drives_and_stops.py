"""The driver of a LeKiwi in lerobot's environment with lerobot's own class, and nine motors with
the protocol of the real ones.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from own_robots import NEEDED, Cell, DriverError, Process, children, process_with

from rn_robot_lerobot.bus.arm import SERIAL_LEKIWI, RollingArm
from rn_robot_lerobot.bus.chain import WRITE, BusFaults, Packet
from rn_robot_lerobot.bus.motors import VELOCITY_MODE
from rn_robot_lerobot.omni_base import (
    WHEEL_LIMIT_RAD_S,
    WHEELS,
    BaseSetpoint,
    base_velocity,
    possible,
    wheel_speeds,
)
from rn_simulation.planar_motion import PlanarPose
from rn_testing.waiting import wait_until

MODE, TORQUE, SPEED = 33, 40, 46
TIMEOUT_S = 0.5
REST_S = 1.0
"""From the last command to wheels at rest: the deadman time, and braking from 0.2 m/s."""
GONE_S, FROZEN_S = 0.5, 1.0
"""From the death of a driver, or its freeze, to wheels at rest."""
own_lerobot = [pytest.mark.slow, pytest.mark.timeout(180), NEEDED]


def test_wheels_make_the_velocity_that_they_are_asked_for() -> None:
    for velocity in ((0.1, 0.0, 0.0), (0.0, -0.1, 0.0), (0.05, 0.02, 0.4)):
        asked = np.array(velocity)
        np.testing.assert_allclose(base_velocity(wheel_speeds(asked)), asked, atol=1e-12)
    # driving forwards, the back wheel stands still; turning left, all wheels turn alike
    assert wheel_speeds(np.array((0.1, 0.0, 0.0)))[1] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(wheel_speeds(np.array((0.0, 0.0, 0.4))), 1.0)


def test_what_is_too_fast_for_a_wheel_is_slowed_in_its_direction() -> None:
    asked = np.array((0.2, 0.2, 1.0))
    found = possible(asked)
    assert np.abs(wheel_speeds(found)).max() == pytest.approx(WHEEL_LIMIT_RAD_S)
    np.testing.assert_allclose(found / found[0], asked / asked[0])
    slow = np.array((0.1, 0.0, 0.0))
    np.testing.assert_array_equal(possible(slow), slow)


def test_a_base_whose_commands_cease_brakes_within_its_acceleration() -> None:
    base, now_s, speeds = BaseSetpoint(TIMEOUT_S), 10.0, []
    base.aim(np.array((0.2, 0.0, 0.0)), now_s)
    for _ in range(100):
        now_s += 0.02
        base.advance(0.02, now_s)
        speeds.append(base.velocity[0])
    assert max(speeds) == pytest.approx(0.2)
    assert np.diff(speeds).max() <= 0.5 * 0.02 + 1e-12
    assert np.diff(speeds).min() >= -1.0 * 0.02 - 1e-12
    assert base.is_still
    assert base.motion == "stopping: no command for 0.5 s"


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    with process_with(tmp_path_factory.mktemp("lerobot") / "driver.log") as process:
        yield process


@pytest.fixture
def cell(tmp_path: Path, process: Process) -> Iterator[Cell]:
    with ExitStack() as stack:
        cell = Cell(SERIAL_LEKIWI, tmp_path, process, stack)
        yield cell
        with suppress(DriverError):
            process("close")  # before its port is gone


def pose(cell: Cell) -> PlanarPose:
    """True pose of the base."""
    plant = cell.arm.plant
    assert isinstance(plant, RollingArm)
    return plant.pose


def is_rolling(cell: Cell) -> bool:
    return bool(np.abs(cell.arm.plant.joint_states()[1][6:]).max() > 1e-3)


@contextmanager
def driving(cell: Cell, *velocity: float) -> Iterator[None]:
    """Send commands ten times a second until the end, or until the process refuses one."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(0.1):
            cell.driver("drive", *velocity)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def is_running(pid: int) -> bool:
    """True also after the death of its parent; a zombie does not count."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def later(since_s: float, seconds: float) -> Callable[[], bool]:
    return lambda: time.monotonic() > since_s + seconds


class TestWithLerobotsOwnClass:
    pytestmark = own_lerobot

    def test_the_base_drives_and_tells_where_it_is_and_the_arm_stays(self, cell: Cell) -> None:
        cell.driver("open")
        home = cell.arm.position[:5].copy()
        with driving(cell, 0.15, 0.05, 0.3):
            wait_until(lambda: pose(cell).x_m > 0.15, 20.0, "the base to drive")
            told = cell.driver("odometry")
            assert told["velocity"] == pytest.approx([0.15, 0.05, 0.3], abs=0.02)
        wait_until(lambda: not is_rolling(cell), 5.0)
        true, told = pose(cell), json.loads(cell.driver("read")["odometry"])
        assert true.y_m > 0.05
        assert true.yaw_rad > 0.2
        assert [told["x_m"], told["y_m"]] == pytest.approx([true.x_m, true.y_m], abs=0.03)
        assert told["yaw_rad"] == pytest.approx(true.yaw_rad, abs=0.1)
        np.testing.assert_allclose(cell.arm.position[:5], home, atol=0.01)
        assert cell.arm.motors.broken_rules == []

    def test_the_arm_moves_while_the_base_drives(self, cell: Cell) -> None:
        cell.driver("open")
        with driving(cell, 0.0, 0.1, 0.0):
            cell.driver("send", {"shoulder_pan": 0.4, "gripper": 0.6}, 0.5)
            wait_until(lambda: abs(cell.arm.position[0] - 0.4) < 0.01, 20.0)
            wait_until(lambda: pose(cell).y_m > 0.05, 20.0)
        assert cell.driver.fault() == ""

    def test_a_base_whose_commands_cease_stops(self, cell: Cell) -> None:
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            wait_until(lambda: pose(cell).x_m > 0.05, 20.0)
        last_s = time.monotonic()
        wait_until(lambda: not is_rolling(cell), 10.0)
        assert time.monotonic() - last_s < TIMEOUT_S + REST_S
        assert cell.driver("read")["motion"] == "stopping: no command for 0.5 s"

    @pytest.mark.parametrize("ending", ["hold", "close"])
    def test_a_hold_and_the_end_stop_base_and_arm(self, cell: Cell, ending: str) -> None:
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            cell.turn()
        cell.driver("drive", 0.2, 0.0, 0.0)
        begun_s = time.monotonic()
        cell.driver(ending)
        wait_until(later(begun_s, 1.5))
        assert not is_rolling(cell)
        assert cell.arm.rest_after_s(begun_s) < REST_S

    @pytest.mark.parametrize(
        ("velocity", "words"),
        [
            ((0.3, 0.0, 0.0), "linear.x is 0.3, expected -0.2 .. 0.2"),
            ((float("nan"), 0.0, 0.0), "linear.x is nan, expected a finite number"),
        ],
    )
    def test_a_velocity_beyond_the_limits_is_refused_and_the_base_brakes(
        self, cell: Cell, velocity: tuple[float, float, float], words: str
    ) -> None:
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            wait_until(lambda: pose(cell).x_m > 0.05, 20.0)
        cell.driver("drive", *velocity)
        state = cell.driver("read")
        assert words in state["refused"]
        assert state["refused_count"] == "1"
        wait_until(lambda: not is_rolling(cell), 5.0)

    def test_after_a_silent_bus_the_wheels_are_stopped_and_do_not_start_by_themselves(
        self, cell: Cell
    ) -> None:
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            wait_until(lambda: pose(cell).x_m > 0.05, 20.0)
            cell.arm.motors.faults = BusFaults(silent=True)
            wait_until(lambda: "is silent: " in cell.driver.fault(), 10.0)
            # nothing can reach them
            assert is_rolling(cell)
            cell.arm.motors.faults = BusFaults()
            wait_until(lambda: not is_rolling(cell), 5.0)
            assert "held by a fault" in cell.driver("read")["refused"]

    def test_wheels_of_a_bus_that_does_not_answer_hear_that_they_are_to_stop(
        self, cell: Cell
    ) -> None:
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            wait_until(lambda: pose(cell).x_m > 0.05, 20.0)
            cell.arm.motors.faults = BusFaults(mute=True)
            wait_until(lambda: not is_rolling(cell), 10.0)
            assert "is silent: " in cell.driver.fault()

    def test_wheels_that_still_turn_for_a_driver_that_was_killed_are_stopped_at_the_start(
        self, cell: Cell
    ) -> None:
        motors = cell.arm.motors
        for number in range(7, 10):
            motors.answer(Packet(number, WRITE, bytes((MODE, VELOCITY_MODE))))
            motors.answer(Packet(number, WRITE, bytes((TORQUE, 1))))
            motors.answer(Packet(number, WRITE, bytes((SPEED, *(800).to_bytes(2, "little")))))
        wait_until(lambda: is_rolling(cell), 5.0)
        cell.driver("open")
        wait_until(lambda: not is_rolling(cell), 2.0)
        assert set(motors.speeds().values()) == {0.0}
        assert len(motors.speeds()) == len(WHEELS)

    def test_a_lost_guard_is_a_fault_that_stops_the_base(self, cell: Cell) -> None:
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            wait_until(lambda: pose(cell).x_m > 0.05, 20.0)
            (guard,) = children(cell.driver.pid)
            os.kill(guard, signal.SIGKILL)
            wait_until(lambda: not is_rolling(cell), 5.0)
            refused = "The base is held by a fault: the guard of the wheels has ended; start"
            wait_until(lambda: refused in cell.driver("read")["refused"], 5.0)
        with pytest.raises(DriverError, match="the guard of the wheels has ended"):
            cell.driver("send", {"shoulder_pan": 0.1}, 0.5)
        cell.driver("close")
        cell.driver("open")
        with driving(cell, 0.2, 0.0, 0.0):
            wait_until(lambda: is_rolling(cell), 20.0)

    def test_the_end_leaves_no_process_behind(self, cell: Cell) -> None:
        cell.driver("open")
        assert len(children(cell.driver.pid)) == 1
        cell.driver("close")
        assert children(cell.driver.pid) == []
        cell.arm.motors.faults = BusFaults(silent=True)
        with pytest.raises(DriverError):
            cell.driver("open")
        assert children(cell.driver.pid) == []

    @pytest.mark.parametrize(
        ("number", "bound_s"), [(signal.SIGKILL, GONE_S), (signal.SIGSTOP, FROZEN_S)]
    )
    def test_the_wheels_of_a_lost_driver_stop(
        self, tmp_path: Path, number: signal.Signals, bound_s: float
    ) -> None:
        with process_with(tmp_path / "lost.log") as process, ExitStack() as stack:
            cell = Cell(SERIAL_LEKIWI, tmp_path, process, stack)
            # with long-lived commands only the guard stops it quickly
            process("new", "lekiwi", cell.options | {"base_timeout_s": 5.0})
            process("open")
            (guard,) = children(process.pid)
            process("drive", 0.2, 0.0, 0.0)
            wait_until(lambda: pose(cell).x_m > 0.05, 20.0)
            begun_s = time.monotonic()
            os.kill(process.pid, number)
            wait_until(lambda: not is_rolling(cell), 10.0)
            after_s = time.monotonic() - begun_s
            print(f"wheels at rest {after_s:.2f} s after {number.name}")
            assert after_s < bound_s
            wait_until(lambda: not is_running(guard), 5.0)
            if number == signal.SIGSTOP:
                stood = pose(cell)
                os.kill(process.pid, signal.SIGCONT)
                wait_until(lambda: "has ended" in process.fault(), 5.0)
                process("drive", 0.2, 0.0, 0.0)
                assert "the guard of the wheels has ended" in process("read")["refused"]
                assert pose(cell) == stood
