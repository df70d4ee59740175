"""A hung control process is reported as a fault within seconds, and blocks nothing."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.fci import arm as arm_module
from rn_robot_fr3.fci import driver as driver_module
from rn_robot_fr3.fci.arm import ClientError, FciArm
from rn_robot_fr3.fci.driver import FciDriver
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.profile import profile
from rn_testing.fakes import MemoryTopics

OPTIONS = FciDriverOptions(host="10.0.0.1", gripper=False)
STATE: dict[str, Any] = {
    **{name: [0.0] * 7 for name in ("q", "dq", "tau_J", "tau_ext_hat_filtered")},
    "O_F_ext_hat_K": [0.0] * 6,
    "O_T_EE": np.eye(4).ravel().tolist(),
    "mode": "Idle",
    "rate": 1.0,
    "errors": [],
    "missed": 0,
    "longest": 0,
    "silences": 0,
    "moving": False,
    "number": 0,
    "realtime": False,
}


class Clock:
    """Both clocks of a process, stopped until the test sets them."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def now_ns(self) -> int:
        return int(self.now_s * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(arm_module, "time", made)
    monkeypatch.setattr(driver_module, "time", made)
    return made


@pytest.fixture
def arm() -> Iterator[FciArm]:
    """An arm connected to a process that reads nothing."""
    made = FciArm(OPTIONS)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        made._link = ours
        yield made


@pytest.fixture
def driver(clock: Clock, arm: FciArm) -> FciDriver:
    """An open driver with this arm."""
    made = FciDriver(OPTIONS, profile(), MemoryTopics(now_ns=clock.now_ns))
    made._arm = arm
    arm._take(STATE)
    made._take(arm.read())
    return made


def test_a_message_to_a_process_that_reads_nothing_is_refused_at_once(arm: FciArm) -> None:
    def fill() -> None:
        for _ in range(100_000):
            arm._send({"do": "alive"})

    with pytest.raises(ClientError, match="does not read") as raised:
        fill()
    assert raised.value.kind == "NetworkException"


def test_a_state_that_is_too_old_is_no_state(clock: Clock, arm: FciArm) -> None:
    arm._take(STATE)
    clock.now_s += 1.4
    assert arm.read().mode == "Idle"
    clock.now_s += 0.2
    with pytest.raises(ClientError, match=r"no state for 1\.6 s"):
        arm.read()


def test_the_driver_names_the_fault(clock: Clock, driver: FciDriver, arm: FciArm) -> None:
    clock.now_s += 2.0
    with pytest.raises(ClientError) as raised:
        driver._look_after(arm)
    driver._end(arm, raised.value)
    assert driver.read().detail["fault"].startswith("communication_lost")


def test_an_old_state_keeps_its_stamp(clock: Clock, driver: FciDriver, arm: FciArm) -> None:
    measured_ns = driver.read().joints.stamp_ns
    assert measured_ns == clock.now_ns()
    clock.now_s += 0.5
    driver._look_after(arm)
    assert driver.read().joints.stamp_ns == measured_ns
    arm._take(STATE)
    clock.now_s += 0.003  # later than its arrival, as the thread runs every 8 ms
    driver._look_after(arm)
    assert driver.read().joints.stamp_ns == pytest.approx(measured_ns + 500_000_000, abs=1000)
