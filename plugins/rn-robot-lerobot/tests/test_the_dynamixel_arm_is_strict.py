"""The simulated Koch arm: behaviour specific to Dynamixel's motors."""

from __future__ import annotations

import numpy as np
import pytest
from motor_master import DYNAMIXEL, Master

from rn_robot_lerobot.bus.chain import BROADCAST, PING, Packet
from rn_robot_lerobot.bus.dynamixel_motors import (
    ACCESS_ERROR,
    EXTENDED_MODE,
    MODEL_XL330,
    MODEL_XL430,
    DynamixelChain,
)
from rn_robot_lerobot.bus.dynamixel_packets import packed, status

MODE, OFFSET, GOAL, POSITION = 11, 20, 116, 132


@pytest.fixture
def master() -> Master:
    return Master(DYNAMIXEL)


def test_a_packet_is_the_one_of_the_protocols_own_example() -> None:
    # ROBOTIS, protocol 2.0, instruction Ping
    assert packed(1, PING, b"") == bytes.fromhex("FFFFFD00 01 0300 01 194E")
    assert status(1, 0, bytes.fromhex("0604 26")) == bytes.fromhex(
        "FFFFFD00 01 0700 55 00 0604 26 655D"
    )
    assert b"\xff\xff\xfd\xfd" in packed(3, 3, b"\xff\xff\xfd\x07")


def test_every_motor_tells_its_model(master: Master) -> None:
    answer = master.motors.answer(Packet(BROADCAST, PING, b""))
    models = [answer[i + 9] | answer[i + 10] << 8 for i in range(0, len(answer), 14)]
    assert models == [MODEL_XL430, MODEL_XL430, *[MODEL_XL330] * 4]


def test_a_position_may_be_negative(master: Master) -> None:
    master.move({1: -4.0})
    assert master.read(1, POSITION) == 2048 + round(-4.0 * 4096 / (2 * np.pi)) < 0


def test_a_motor_that_is_mounted_the_other_way_round_counts_backwards(master: Master) -> None:
    motors = master.motors
    assert isinstance(motors, DynamixelChain)
    motors.invert("elbow_flex")
    master.write(3, MODE, bytes((EXTENDED_MODE,)))
    master.move()
    before = master.read(3, POSITION)
    master.move({3: 0.2})
    assert master.read(3, POSITION) - before == -round(0.2 * 4096 / (2 * np.pi))
    master.power(3)
    master.write(3, GOAL, master.number(before))
    assert motors.goals()[0][2] == pytest.approx(0.0, abs=2e-3)


def test_permanent_memory_is_not_written_under_torque(master: Master) -> None:
    master.power(2)
    assert master.write(2, OFFSET, master.number(7)) == ACCESS_ERROR
    (permanent,) = master.motors.broken_rules
    assert "written while it had torque" in permanent


def test_several_turns_have_no_limits(master: Master) -> None:
    master.write(1, MODE, bytes((EXTENDED_MODE,)))
    master.power(1)
    master.write(1, GOAL, master.number(-500))
    assert master.motors.broken_rules == []
    assert master.motors.goals()[0][0] == pytest.approx((-500 - 2048) * 2 * np.pi / 4096)
