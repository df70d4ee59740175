"""The counterpart of a Koch arm: packets, registers with their raw scale, and rules that a careful
master keeps.
"""

from __future__ import annotations

import numpy as np
import pytest

from rn_robot_lerobot.bus.chain import (
    BROADCAST,
    PING,
    READ,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    BusFaults,
    Packet,
)
from rn_robot_lerobot.bus.dynamixel_motors import (
    ACCESS_ERROR,
    ALERT,
    EXTENDED_MODE,
    MODEL_XL330,
    MODEL_XL430,
    DynamixelChain,
)
from rn_robot_lerobot.bus.dynamixel_packets import PacketReader, packed, status
from rn_robot_lerobot.bus.reference import ASSEMBLED_KOCH

MODE, OFFSET, TORQUE, GOAL, POSITION = 11, 20, 64, 116, 132
ERROR = 8
"""Place of the error in an answer."""


def chain() -> DynamixelChain:
    motors = DynamixelChain(ASSEMBLED_KOCH.encoder_zeros)
    motors.calibrate(ASSEMBLED_KOCH.calibration())
    motors.measure(np.zeros(6), np.zeros(6))
    return motors


def word(value: int) -> bytes:
    return value.to_bytes(2, "little")


def number(value: int) -> bytes:
    return value.to_bytes(4, "little", signed=True)


def write(motors: DynamixelChain, motor: int, address: int, data: bytes) -> bytes:
    return motors.answer(Packet(motor, WRITE, word(address) + data))


def position(motors: DynamixelChain, motor: int) -> int:
    answer = motors.answer(Packet(motor, READ, word(POSITION) + word(4)))
    return int.from_bytes(answer[9:13], "little", signed=True)


def test_a_packet_is_the_one_of_the_protocols_own_example() -> None:
    # ROBOTIS, protocol 2.0, instruction Ping
    assert packed(1, PING, b"") == bytes.fromhex("FFFFFD00 01 0300 01 194E")
    assert status(1, 0, bytes.fromhex("0604 26")) == bytes.fromhex(
        "FFFFFD00 01 0700 55 00 0604 26 655D"
    )


def test_packets_are_found_among_noise_and_damaged_ones_are_dropped() -> None:
    reader, packet = PacketReader(), Packet(3, WRITE, word(GOAL) + b"\xff\xff\xfd\x07")
    whole = packed(packet.motor, packet.instruction, packet.parameters)
    assert b"\xff\xff\xfd\xfd" in whole
    damaged = bytearray(whole)
    damaged[-1] ^= 1
    stream = b"\x00\xff" + whole + bytes(damaged) + whole
    found = [one for i in range(len(stream)) for one in reader.feed(stream[i : i + 1])]
    assert found == [packet, packet]
    assert reader.damaged == 1


def test_every_motor_tells_its_model() -> None:
    answer = chain().answer(Packet(BROADCAST, PING, b""))
    models = [answer[i + 9] | answer[i + 10] << 8 for i in range(0, len(answer), 14)]
    assert models == [MODEL_XL430, MODEL_XL430, *[MODEL_XL330] * 4]


def test_position_nought_is_the_middle_and_a_joint_moves_its_steps() -> None:
    motors = chain()
    assert [position(motors, motor) for motor in range(1, 7)] == [2048] * 6
    motors.measure(np.full(6, -4.0), np.zeros(6))
    assert position(motors, 1) == 2048 + round(-4.0 * 4096 / (2 * np.pi)) < 0


def test_a_motor_that_is_mounted_the_other_way_round_counts_backwards() -> None:
    motors = chain()
    motors.invert("elbow_flex")
    write(motors, 3, MODE, bytes((EXTENDED_MODE,)))
    motors.measure(np.zeros(6), np.zeros(6))
    before = position(motors, 3)
    motors.measure(np.full(6, 0.2), np.zeros(6))
    assert position(motors, 3) - before == -round(0.2 * 4096 / (2 * np.pi))
    write(motors, 3, TORQUE, b"\x01")
    write(motors, 3, GOAL, number(before))
    assert motors.goals()[0][2] == pytest.approx(0.0, abs=2e-3)


def test_all_motors_answer_a_group_and_take_a_group() -> None:
    motors = chain()
    answer = motors.answer(
        Packet(BROADCAST, SYNC_READ, word(POSITION) + word(4) + bytes(range(1, 7)))
    )
    assert len(answer) == 6 * 15
    for motor in range(1, 7):
        assert write(motors, motor, TORQUE, b"\x01")[ERROR] == 0
    values = b"".join(bytes((motor,)) + number(2100) for motor in range(1, 7))
    assert motors.answer(Packet(BROADCAST, SYNC_WRITE, word(GOAL) + word(4) + values)) == b""
    goals, torque = motors.goals()
    assert torque.all()
    assert goals == pytest.approx((2100 - 2048) * 2 * np.pi / 4096)
    assert motors.broken_rules == []


def test_careless_writes_are_refused_or_clamped_and_noted() -> None:
    motors = chain()
    write(motors, 1, GOAL, number(2100))
    write(motors, 2, TORQUE, b"\x01")
    write(motors, 2, GOAL, number(4000))
    assert write(motors, 2, OFFSET, number(7))[ERROR] == ACCESS_ERROR
    without_torque, outside, permanent = motors.broken_rules
    assert "goal 2100 without torque" in without_torque
    assert "goal 4000 outside" in outside
    assert "written while it had torque" in permanent
    assert motors.goals()[0][1] < 1.2


def test_several_turns_have_no_limits() -> None:
    motors = chain()
    write(motors, 1, MODE, bytes((EXTENDED_MODE,)))
    write(motors, 1, TORQUE, b"\x01")
    write(motors, 1, GOAL, number(-500))
    assert motors.broken_rules == []
    assert motors.goals()[0][0] == pytest.approx((-500 - 2048) * 2 * np.pi / 4096)


def test_faults_are_what_they_say() -> None:
    motors = chain()
    motors.faults = BusFaults(wrong={"elbow_flex": 500})
    assert position(motors, 3) == 2548
    motors.faults = BusFaults(error=ALERT)
    assert motors.answer(Packet(3, PING, b""))[ERROR] == ALERT
    motors.faults = BusFaults(silent=True)
    assert motors.answer(Packet(3, PING, b"")) == b""
