"""The process that stops a LeKiwi's wheels for a driver that cannot, with simulated motors. The
drivers killed here have no lerobot; those in `test_a_lekiwi_drives_and_stops` have.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from own_robots import children

from rn_robot_lerobot.bus.arm import SERIAL_LEKIWI, SerialArm
from rn_robot_lerobot.bus.chain import WRITE, Packet
from rn_robot_lerobot.bus.motors import VELOCITY_MODE, wheel_stop
from rn_robot_lerobot.bus.packets import sync_write
from rn_robot_lerobot.wheel_guard import WheelGuard
from rn_robot_lerobot.wheel_guard_process import SILENT_S
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError

WHEELS = range(7, 10)
MODE, TORQUE, SPEED = 33, 40, 46
HUNG_S = 2.0


@pytest.fixture
def arm() -> Iterator[SerialArm]:
    """A LeKiwi with rolling wheels."""
    with SerialArm(SERIAL_LEKIWI) as arm:
        for number in WHEELS:
            for address, value in ((MODE, VELOCITY_MODE), (TORQUE, 1), (SPEED, 800)):
                data = value.to_bytes(2 if address == SPEED else 1, "little")
                arm.motors.answer(Packet(number, WRITE, bytes((address,)) + data))
        wait_until(lambda: is_rolling(arm), 5.0)
        yield arm


@pytest.fixture
def guard(arm: SerialArm) -> Iterator[WheelGuard]:
    guard = WheelGuard(arm.port, wheel_stop(WHEELS))
    guard.start()
    yield guard
    guard.close(wheels_stand=True)


def is_rolling(arm: SerialArm) -> bool:
    return bool(np.abs(arm.plant.joint_states()[1][6:]).max() > 1e-3)


def process_of(guard: WheelGuard, before: list[int]) -> int:
    (pid,) = set(children(os.getpid())) - set(before)
    return pid


def test_the_packets_are_those_of_the_protocol() -> None:
    speed, torque = wheel_stop(WHEELS)
    # FF FF, broadcast, length, sync write, register, bytes per motor, (motor, data) three times,
    # checksum
    assert speed.hex(" ") == "ff ff fe 0d 83 2e 02 07 00 00 08 00 00 09 00 00 29"
    assert torque.hex(" ") == "ff ff fe 0a 83 28 01 07 00 08 00 09 00 33"


def test_a_bus_that_takes_its_time_is_no_reason(arm: SerialArm, guard: WheelGuard) -> None:
    guard.note(is_rolling=True)
    begun_s = time.monotonic()
    wait_until(lambda: time.monotonic() - begun_s > 2.0 * SILENT_S)
    assert guard.fault() == ""
    assert is_rolling(arm)


def test_a_bus_that_hangs_is_one(arm: SerialArm, guard: WheelGuard) -> None:
    guard.note(is_rolling=True)
    begun_s = time.monotonic()
    wait_until(lambda: not is_rolling(arm), HUNG_S + SILENT_S + 5.0)
    assert time.monotonic() - begun_s > HUNG_S
    wait_until(lambda: "has ended" in guard.fault(), 5.0)
    assert not any(arm.motors.has_torque(number - 1) for number in WHEELS)
    assert arm.motors.broken_rules == []


@pytest.mark.exhaustive
def test_a_driver_of_standing_wheels_may_be_busy(arm: SerialArm, guard: WheelGuard) -> None:
    guard.note(is_rolling=True)
    guard.note(is_rolling=False)
    begun_s = time.monotonic()
    wait_until(lambda: time.monotonic() - begun_s > HUNG_S + 2.0 * SILENT_S, 10.0)
    assert guard.fault() == ""
    assert is_rolling(arm)


@pytest.mark.parametrize(
    ("number", "words"),
    [(signal.SIGKILL, "has ended"), (signal.SIGSTOP, "does not answer")],
)
def test_a_guard_that_is_lost_is_a_fault(
    arm: SerialArm, number: signal.Signals, words: str
) -> None:
    before = children(os.getpid())
    guard = WheelGuard(arm.port, wheel_stop(WHEELS))
    guard.start()
    assert guard.fault() == ""
    os.kill(process_of(guard, before), number)
    wait_until(lambda: words in guard.fault(), 5.0)
    guard.close(wheels_stand=True)
    assert children(os.getpid()) == before


@pytest.mark.parametrize("wheels_stand", [True, False])
def test_it_ends_with_its_driver_and_stops_what_does_not_stand(
    arm: SerialArm, wheels_stand: bool
) -> None:
    before = children(os.getpid())
    guard = WheelGuard(arm.port, wheel_stop(WHEELS))
    guard.start()
    # a signal to the driver's process group, or from a terminal, does not reach it
    os.kill(process_of(guard, before), signal.SIGTERM)
    assert os.getpgid(process_of(guard, before)) != os.getpgid(0)
    guard.close(wheels_stand=wheels_stand)
    assert children(os.getpid()) == before
    if not wheels_stand:
        wait_until(lambda: not is_rolling(arm), 5.0)
    assert is_rolling(arm) == wheels_stand


def test_a_packet_that_the_driver_has_not_finished_is_no_obstacle(arm: SerialArm) -> None:
    guard = WheelGuard(arm.port, wheel_stop(WHEELS))
    guard.start()
    begun = sync_write(WHEELS, SPEED, bytes((200, 0)))[:11]
    with open(arm.port, "wb", buffering=0) as port:
        port.write(begun)
    guard.close(wheels_stand=False)
    wait_until(lambda: not is_rolling(arm), 5.0)


def test_a_port_that_cannot_be_opened_is_said() -> None:
    guard = WheelGuard("/dev/absent", wheel_stop(WHEELS))
    with pytest.raises(NotReadyError, match=r"guard of the wheels does not start: .*/dev/absent"):
        guard.start()
    guard.close(wheels_stand=False)
