"""The simulated SO-101 and LeKiwi: behaviour specific to Feetech's motors, and the port."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from motor_master import FEETECH, LEKIWI, Master, feetech

from rn_robot_lerobot.bus.arm import SerialArm
from rn_robot_lerobot.bus.chain import SYNC_WRITE, WRITE, Packet
from rn_robot_lerobot.bus.motors import VELOCITY_MODE, decode, encode
from rn_testing.waiting import wait_until

GOAL, TORQUE, MODE, SPEED, LOCK, POSITION, VELOCITY, LOWEST = 42, 40, 33, 46, 55, 56, 58, 9


def test_a_negative_number_has_a_sign_bit() -> None:
    assert decode(encode(-300, 11), 11) == -300
    assert encode(-300, 11) == 300 | 1 << 11


def test_permanent_memory_is_not_written_while_it_is_locked() -> None:
    master = Master(FEETECH)
    master.write(1, LOCK, b"\x01")
    master.write(1, LOWEST, master.number(5))
    (locked,) = master.motors.broken_rules
    assert "written while it was locked" in locked


def test_a_wheel_follows_a_speed_with_its_sign_and_counts_turns_from_nought_again() -> None:
    master = Master(LEKIWI)
    assert master.motors.speeds() == {}
    master.write(8, MODE, bytes((VELOCITY_MODE,)))
    master.power(8)
    master.write(8, SPEED, master.number(-1024))
    assert master.motors.speeds() == {7: pytest.approx(-np.pi / 2)}
    master.move({8: -20.0}, speed=-np.pi / 2)
    assert master.read(8, VELOCITY) == -1024
    assert master.read(8, POSITION) == round(-20.0 * 4096 / (2 * np.pi)) % 4096
    assert master.motors.broken_rules == []


def test_careless_speeds_and_goals_of_wheels_are_noted() -> None:
    master = Master(LEKIWI)
    master.write(7, SPEED, master.number(100))
    master.write(7, MODE, bytes((VELOCITY_MODE,)))
    master.power(7)
    master.write(7, GOAL, master.number(2000))
    speed, goal = master.motors.broken_rules
    assert "speed for a motor that does not roll" in speed
    assert "goal 2000 for a motor that rolls" in goal


def test_the_arm_follows_goals_that_come_over_its_port() -> None:
    with SerialArm() as arm:
        port = os.open(arm.port, os.O_RDWR | os.O_NOCTTY)
        try:
            for number in range(1, 7):
                os.write(port, feetech(Packet(number, WRITE, bytes((TORQUE, 1)))))
            begun_s = time.monotonic()
            goal = bytes((GOAL, 2, 1)) + (2048 + 326).to_bytes(2, "little")
            os.write(port, feetech(Packet(254, SYNC_WRITE, goal)))
            wait_until(lambda: abs(arm.position[0] - 0.5) < 0.01, 5.0)
            wait_until(lambda: arm.rest_after_s(time.monotonic() - 0.2) == 0.0, 5.0)
            assert arm.rest_after_s(begun_s) > 0.1
        finally:
            os.close(port)
