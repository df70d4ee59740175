"""An agent's tools, the one gate, RoboNeuron's robot module in lerobot's environment, lerobot's own
LeKiwi class, and behind a serial port nine motors with the protocol of the real ones.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest
from serial_cell import SerialCell

from rn_robot_lerobot.bus.arm import SERIAL_LEKIWI, RollingArm
from rn_simulation.planar_motion import PlanarPose
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError
from roboneuron.command import environment

STOPPED_S = 1.0
"""Time from a stop to wheels at rest: 0.2 s of braking, and a margin for a busy machine."""
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SerialCell]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    environment.prepare_environment()
    with ExitStack() as stack:
        cell = SerialCell(tmp_path, stack, SERIAL_LEKIWI)
        cell.write_calibration(SERIAL_LEKIWI.assembled.calibration())
        yield cell


def pose(cell: SerialCell) -> PlanarPose:
    plant = cell.arm.plant
    assert isinstance(plant, RollingArm)
    return plant.pose


def is_rolling(cell: SerialCell) -> bool:
    return bool(np.abs(cell.arm.plant.joint_states()[1][6:]).max() > 1e-3)


def drive(cell: SerialCell, seconds: float, **linear: float) -> None:
    cell.server.call("publish_velocity", message={"linear": linear}, duration_s=seconds)


def drive_in_background(cell: SerialCell) -> None:
    """Start a long drive; the call ends when the base is stopped."""

    def call() -> None:
        with suppress(NotReadyError):
            drive(cell, 8.0, x=0.2)

    begun_m = pose(cell).x_m
    threading.Thread(target=call, daemon=True).start()
    wait_until(lambda: pose(cell).x_m > begun_m + 0.05, 60.0, "the base to drive")


def rest_after_s(cell: SerialCell, begun_s: float) -> float:
    wait_until(lambda: not is_rolling(cell), 20.0, "the wheels to stop")
    return time.monotonic() - begun_s


def test_velocities_pass_the_gate_and_stops_hold_base_and_arm(cell: SerialCell) -> None:
    cell.start()
    home = cell.arm.position[:5].copy()
    drive(cell, 1.5, x=0.15, y=-0.05)
    assert rest_after_s(cell, time.monotonic()) < STOPPED_S
    driven = pose(cell)
    # 0.2 m, and more if a busy machine stops it late
    assert 0.12 < driven.x_m < 0.6
    assert driven.y_m == pytest.approx(-driven.x_m / 3.0, abs=0.03)
    np.testing.assert_allclose(cell.arm.position[:5], home, atol=0.01)
    with pytest.raises(NotReadyError, match=r"linear\.x is 0\.5, allowed is -0\.2 \.\. 0\.2"):
        drive(cell, 1.0, x=0.5)
    cell.move(shoulder_pan=0.3, seconds=1.0)
    wait_until(lambda: abs(cell.arm.position[0] - 0.3) < 0.01, 5.0)
    assert cell.arm.motors.broken_rules == []

    drive_in_background(cell)
    begun_s = time.monotonic()
    os.kill(int(str(cell.robot()["pid"])), signal.SIGKILL)
    after_s = rest_after_s(cell, begun_s)
    print(f"wheels at rest {after_s:.2f} s after the death of their driver")
    assert after_s < STOPPED_S
    cell.server.call("start_robot")

    drive_in_background(cell)
    begun_s = time.monotonic()
    cell.server.call("emergency_stop")
    after_s = rest_after_s(cell, begun_s)
    print(f"wheels at rest {after_s:.2f} s after the stop")
    assert after_s < STOPPED_S
    stopped = pose(cell)
    with pytest.raises(NotReadyError, match="mergency stop"):
        drive(cell, 0.5, x=0.1)
    assert pose(cell) == stopped
