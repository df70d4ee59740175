"""RoboNeuron's robot module in lerobot's environment, lerobot's own SO-101 follower, and behind a
serial port a simulated arm whose motors have the protocol of the real ones.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from serial_cell import SerialCell

from rn_robot_lerobot.arm import SO101
from rn_robot_lerobot.bus.chain import BusFaults
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError
from roboneuron.command import environment

REST_S = 0.5
"""Time from a fault to an arm at rest: the timeout that is the fault, and the motor's remaining
motion to its last goal. The fault matrix allows `command_timeout_s`.
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    environment.prepare_environment()
    return tmp_path


@pytest.fixture
def cell(folder: Path) -> Iterator[SerialCell]:
    with ExitStack() as stack:
        cell = SerialCell(folder, stack)
        cell.write_calibration(ASSEMBLED_SO101.calibration())
        yield cell


def assert_still(cell: SerialCell, seconds: float = 1.5) -> None:
    begun_s = time.monotonic()
    wait_until(lambda: time.monotonic() > begun_s + seconds)
    assert cell.arm.rest_after_s(begun_s) == 0.0


@pytest.mark.ros
@pytest.mark.slow
def test_it_goes_where_it_is_sent_and_breaks_no_rule_of_the_motors(cell: SerialCell) -> None:
    cell.start()
    np.testing.assert_allclose(cell.arm.position[:5], SO101.home_rad, atol=0.01)
    cell.move(shoulder_pan=0.4, elbow_flex=-0.3, wrist_roll=-0.5)
    # without the motors' dead zone; a step of the encoder is 1.5 mrad
    expected = [0.4, SO101.home_rad[1], -0.3, SO101.home_rad[3], -0.5]
    wait_until(lambda: np.abs(cell.arm.position[:5] - expected).max() < 0.01, 5.0)
    assert cell.arm.motors.broken_rules == []
    assert cell.fault() == ""


@pytest.mark.ros
@pytest.mark.slow
def test_lost_and_late_packets_do_not_keep_it_from_arriving(cell: SerialCell) -> None:
    cell.start()
    cell.arm.motors.faults = BusFaults(lost_share=0.02, answer_delay_s=0.002)
    cell.move(shoulder_pan=0.5)
    wait_until(lambda: abs(cell.arm.position[0] - 0.5) < 0.01, 5.0)
    assert cell.arm.motors.broken_rules == []


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "words"),
    [
        (BusFaults(silent=True), "is silent: "),
        (BusFaults(wrong={"elbow_flex": 700}), "motor 'elbow_flex' tells"),
    ],
    ids=["silent", "wrong"],
)
def test_a_bad_bus_is_a_fault_and_leaves_an_arm_at_rest(
    cell: SerialCell, faults: BusFaults, words: str
) -> None:
    cell.start()
    cell.move_in_background()
    begun_s = time.monotonic()
    cell.arm.motors.faults = faults
    wait_until(lambda: words in cell.fault(), 10.0, "the fault to be told")
    wait_until(lambda: time.monotonic() > begun_s + 2.0)
    after_s = cell.arm.rest_after_s(begun_s)
    print(f"at rest {after_s:.2f} s after the bus was {words!r}")
    assert after_s < REST_S
    cell.arm.motors.faults = BusFaults()
    assert_still(cell)
    cell.move(shoulder_pan=0.0)
    wait_until(lambda: abs(cell.arm.position[0]) < 0.01, 5.0)


@pytest.mark.ros
@pytest.mark.slow
def test_an_emergency_stop_and_a_killed_driver_leave_an_arm_at_rest(cell: SerialCell) -> None:
    cell.start()
    cell.move_in_background()
    begun_s = time.monotonic()
    os.kill(int(str(cell.robot()["pid"])), signal.SIGKILL)
    wait_until(lambda: time.monotonic() > begun_s + 2.0)
    killed_s = cell.arm.rest_after_s(begun_s)
    cell.server.call("start_robot")
    cell.move(shoulder_pan=0.0)
    cell.move_in_background()
    begun_s = time.monotonic()
    cell.server.call("emergency_stop")
    wait_until(lambda: time.monotonic() > begun_s + 2.0)
    stopped_s = cell.arm.rest_after_s(begun_s)
    print(f"at rest {killed_s:.2f} s after its driver was killed, {stopped_s:.2f} s after the stop")
    assert max(killed_s, stopped_s) < REST_S
    assert_still(cell)


@pytest.mark.ros
@pytest.mark.slow
def test_what_is_wrong_with_a_calibration_is_said_before_anything_moves(folder: Path) -> None:
    other = ASSEMBLED_SO101.calibration()
    other["elbow_flex"] = replace(other["elbow_flex"], homing_offset=17)
    unknown = {**ASSEMBLED_SO101.calibration(), "tail": other["gripper"]}
    with ExitStack() as stack:
        cell = SerialCell(folder, stack)
        for calibration, words in (
            (None, r"There is no calibration .*so101\.json\. Make it with: lerobot-calibrate"),
            (unknown, "names the unknown motor 'tail'"),
            (other, "hold another calibration than"),
        ):
            if calibration is not None:
                cell.write_calibration(calibration)
            with pytest.raises(NotReadyError, match=words):
                cell.server.call("start_robot")
        assert cell.arm.rest_after_s(0.0) == 0.0
