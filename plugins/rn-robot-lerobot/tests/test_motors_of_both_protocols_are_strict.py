"""The simulated motors: packets, registers with their raw scale, and rules for a careful master,
for both protocols.
"""

from __future__ import annotations

import numpy as np
import pytest
from motor_master import DYNAMIXEL, FEETECH, Master

from rn_robot_lerobot.bus.chain import PING, WRITE, BusFaults, Packet, PacketReader

STEP_RAD = 2 * np.pi / 4096


@pytest.fixture(params=[FEETECH, DYNAMIXEL], ids=["feetech", "dynamixel"])
def master(request: pytest.FixtureRequest) -> Master:
    return Master(request.param)


def test_packets_are_found_among_noise_and_damaged_ones_are_dropped(master: Master) -> None:
    reader = master.dialect.kind.reader()
    assert isinstance(reader, PacketReader)
    # contains the header of protocol 2.0
    packet = Packet(3, WRITE, b"\x74\x00\xff\xff\xfd\x07")
    whole = master.dialect.raw(packet)
    damaged = bytearray(whole)
    damaged[-1] ^= 1
    stream = b"\x00\xff" + whole + bytes(damaged) + whole
    found = [one for i in range(len(stream)) for one in reader.feed(stream[i : i + 1])]
    assert found == [packet, packet]
    assert reader.damaged == 1


def test_position_nought_is_the_middle_and_a_joint_moves_its_steps(master: Master) -> None:
    position = master.motors.registers.position
    assert [master.read(number, position) for number in range(1, 7)] == [2048] * 6
    master.move({1: 0.1}, speed=-0.5)
    assert master.read(1, position) - 2048 == round(0.1 / STEP_RAD)
    assert master.read(1, master.motors.registers.velocity) == round(-0.5 / STEP_RAD)


def test_all_motors_answer_a_group_and_take_a_group(master: Master) -> None:
    registers = master.motors.registers
    one = master.ask(1, registers.position)
    assert len(master.read_all(registers.position)) == 6 * len(one)
    master.power(*range(1, 7))
    assert master.write_all(registers.goal, [2100] * 6) == b""
    goals, torque = master.motors.goals()
    assert torque.all()
    assert goals == pytest.approx((2100 - 2048) * STEP_RAD)
    assert master.motors.broken_rules == []


def test_careless_goals_are_clamped_and_noted(master: Master) -> None:
    goal = master.motors.registers.goal
    master.write(1, goal, master.number(2100))
    master.power(2)
    master.write(2, goal, master.number(4000))
    without_torque, outside = master.motors.broken_rules
    assert "goal 2100 without torque" in without_torque
    assert "goal 4000 outside" in outside
    assert master.motors.goals()[0][1] < 2.0


def test_torque_that_is_switched_on_moves_nothing(master: Master) -> None:
    master.move({1: 0.3})
    master.power(1)
    assert master.motors.goals()[0][0] == pytest.approx(0.3, abs=STEP_RAD)


def test_faults_are_what_they_say(master: Master) -> None:
    motors, position = master.motors, master.motors.registers.position
    motors.faults = BusFaults(wrong={"elbow_flex": 500})
    assert master.read(3, position) == 2548
    motors.faults = BusFaults(error=0x20)
    assert motors.answer(Packet(3, PING, b""))[master.dialect.error_at] == 0x20
    motors.faults = BusFaults(lost_share=0.5)
    heard = sum(bool(master.ask(3, position)) for _ in range(400))
    assert 150 < heard < 250
    motors.faults = BusFaults(silent=True)
    assert master.ask(3, position) == b""
