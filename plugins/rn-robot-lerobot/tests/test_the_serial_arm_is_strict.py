"""The counterpart: packets, registers with their raw scale, and rules that a careful master
keeps.
"""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

from rn_robot_lerobot.arm import JOINTS
from rn_robot_lerobot.bus.arm import SerialArm
from rn_robot_lerobot.bus.chain import (
    PING,
    READ,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    BusFaults,
    Packet,
)
from rn_robot_lerobot.bus.motors import OVERLOAD, FeetechChain, decode, encode
from rn_robot_lerobot.bus.packets import PacketReader, checksum, status
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_testing.waiting import wait_until

GOAL, TORQUE, LOCK, POSITION, LOWEST = 42, 40, 55, 56, 9


def chain() -> FeetechChain:
    motors = FeetechChain(ASSEMBLED_SO101.encoder_zeros)
    motors.calibrate(ASSEMBLED_SO101.calibration())
    motors.measure(np.zeros(6), np.zeros(6))
    return motors


def word(value: int) -> bytes:
    return value.to_bytes(2, "little")


def raw(packet: Packet) -> bytes:
    body = bytes((packet.motor, len(packet.parameters) + 2, packet.instruction))
    body += packet.parameters
    return b"\xff\xff" + body + bytes((checksum(body),))


def test_packets_are_found_among_noise_and_damaged_ones_are_dropped() -> None:
    reader, packet = PacketReader(), Packet(3, READ, bytes((56, 2)))
    damaged = bytearray(raw(packet))
    damaged[-1] ^= 1
    stream = b"\x00\xff" + raw(packet) + bytes(damaged) + raw(packet)
    found = [one for i in range(len(stream)) for one in reader.feed(stream[i : i + 1])]
    assert found == [packet, packet]
    assert reader.damaged == 1


def test_position_nought_is_the_middle_of_the_calibrated_range() -> None:
    motors = chain()
    for number in range(1, 6):
        answer = motors.answer(Packet(number, READ, bytes((POSITION, 2))))
        assert answer == status(number, 0, word(2048))


def test_a_joint_moves_its_steps_and_a_negative_number_has_a_sign_bit() -> None:
    motors = chain()
    motors.measure(np.full(6, 0.1), np.zeros(6))
    answer = motors.answer(Packet(1, READ, bytes((POSITION, 2))))
    assert int.from_bytes(answer[5:7], "little") - 2048 == round(0.1 * 4096 / (2 * np.pi))
    assert decode(encode(-300, 11), 11) == -300
    assert encode(-300, 11) == 300 | 1 << 11


def test_all_motors_answer_a_group_and_take_a_group() -> None:
    motors = chain()
    answer = motors.answer(Packet(254, SYNC_READ, bytes((POSITION, 2, 1, 2, 3, 4, 5, 6))))
    assert len(answer) == 6 * 8
    for number in range(1, 7):
        motors.answer(Packet(number, WRITE, bytes((TORQUE, 1))))
    values = b"".join(bytes((number, *word(2100))) for number in range(1, 7))
    assert motors.answer(Packet(254, SYNC_WRITE, bytes((GOAL, 2)) + values)) == b""
    goals, torque = motors.goals()
    assert torque.all()
    assert goals == pytest.approx((2100 - 2048) * 2 * np.pi / 4096)
    assert motors.broken_rules == []


def test_careless_writes_are_noted_and_clamped() -> None:
    motors = chain()
    motors.answer(Packet(1, WRITE, bytes((GOAL,)) + word(2100)))
    motors.answer(Packet(1, WRITE, bytes((TORQUE, 1))))
    motors.answer(Packet(1, WRITE, bytes((GOAL,)) + word(4000)))
    motors.answer(Packet(1, WRITE, bytes((LOCK, 1))))
    motors.answer(Packet(1, WRITE, bytes((LOWEST,)) + word(5)))
    without_torque, outside, locked = motors.broken_rules
    assert "without torque" in without_torque
    assert "goal 4000 outside" in outside
    assert "written while it was locked" in locked
    assert motors.goals()[0][0] < 2.0


def test_torque_that_is_switched_on_moves_nothing() -> None:
    motors = chain()
    motors.answer(Packet(1, WRITE, bytes((TORQUE, 1))))
    assert motors.goals()[0][0] == pytest.approx(0.0, abs=2e-3)


def test_faults_are_what_they_say() -> None:
    motors = chain()
    ask = Packet(3, READ, bytes((POSITION, 2)))
    motors.faults = BusFaults(wrong={"elbow_flex": 500})
    assert motors.answer(ask) == status(3, 0, word(2548))
    motors.faults = BusFaults(error=OVERLOAD)
    assert motors.answer(Packet(3, PING, b""))[4] == OVERLOAD
    motors.faults = BusFaults(lost_share=0.5)
    heard = sum(bool(motors.answer(ask)) for _ in range(400))
    assert 150 < heard < 250
    motors.faults = BusFaults(silent=True)
    assert motors.answer(ask) == b""


def test_the_arm_follows_goals_that_come_over_its_port() -> None:
    with SerialArm() as arm:
        port = os.open(arm.port, os.O_RDWR | os.O_NOCTTY)
        try:
            for number in range(1, 7):
                os.write(port, raw(Packet(number, WRITE, bytes((TORQUE, 1)))))
            begun_s = time.monotonic()
            goal = bytes((GOAL, 2, 1)) + word(2048 + 326)
            os.write(port, raw(Packet(254, SYNC_WRITE, goal)))
            wait_until(lambda: abs(arm.position[0] - 0.5) < 0.01, 5.0)
            wait_until(lambda: arm.rest_after_s(time.monotonic() - 0.2) == 0.0, 5.0)
            assert arm.rest_after_s(begun_s) > 0.1
        finally:
            os.close(port)
    assert len(JOINTS) == 6
