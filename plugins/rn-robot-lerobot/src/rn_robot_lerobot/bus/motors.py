"""The six motors of a simulated SO-101: their registers, and the raw scale between registers and
joints. Pure computation.

A register holds the encoder's steps (4096 a turn) less the homing offset, low byte first, negative
numbers by a sign bit. Source: Feetech, memory table of the STS3215.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_robot_lerobot.arm import JOINTS
from rn_robot_lerobot.bus.packets import (
    BROADCAST,
    PING,
    READ,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    Packet,
    status,
)
from rn_robot_lerobot.calibration import STEPS, MotorCalibration

F64 = NDArray[np.float64]

MODEL_STS3215 = 777
OVERLOAD = 0x20
"""Error bit of an answer."""
_SIZE = 100
_FIRMWARE, _MODEL, _NUMBER, _LOWEST, _HIGHEST = 0, 3, 5, 9, 11
_OFFSET, _TORQUE, _GOAL, _LOCK, _POSITION, _VELOCITY = 31, 40, 42, 55, 56, 58
"""Addresses; two bytes each, but for the firmware's versions, number, torque and lock."""
_EEPROM_END = 40
_SIGN_BIT = {_OFFSET: 11, _GOAL: 15, _POSITION: 15, _VELOCITY: 15}


def encode(value: int, sign_bit: int) -> int:
    """A number as sign and magnitude."""
    return abs(value) | (1 << sign_bit if value < 0 else 0)


def decode(value: int, sign_bit: int) -> int:
    """The number of a sign and a magnitude."""
    magnitude = value & ((1 << sign_bit) - 1)
    return -magnitude if value >> sign_bit & 1 else magnitude


@dataclass(kw_only=True)
class BusFaults:
    """What is wrong with the bus; may be changed at any time.

    Attributes:
        silent: nothing answers, and nothing arrives.
        lost_share: share of instructions that no motor hears, 0..1.
        answer_delay_s: of each answer [s].
        wrong: steps that are added to the position that a motor tells, by the joint's name.
        error: error bits of every answer.
    """

    silent: bool = False
    lost_share: float = 0.0
    answer_delay_s: float = 0.0
    wrong: Mapping[str, int] | None = None
    error: int = 0


class MotorChain:
    """Motors 1 to 6 on one bus.

    Attributes:
        faults: what is wrong with them.
        broken_rules: what a careful master would not have done, in words, oldest first.
    """

    def __init__(self, encoder_zeros: Mapping[str, int], *, seed: int = 0) -> None:
        """Args:
        encoder_zeros: step of each encoder, without an offset, at the joint's position 0.
        seed: of what is lost.
        """
        self.faults = BusFaults()
        self.broken_rules: list[str] = []
        self._zeros = np.array([encoder_zeros[name] for name in JOINTS])
        self._random = np.random.default_rng(seed)
        self._memories = [bytearray(_SIZE) for _ in JOINTS]
        for number, memory in enumerate(self._memories, 1):
            memory[_FIRMWARE : _FIRMWARE + 2] = bytes((3, 10))
            memory[_MODEL : _MODEL + 2] = MODEL_STS3215.to_bytes(2, "little")
            memory[_NUMBER] = number
            memory[_HIGHEST : _HIGHEST + 2] = (STEPS - 1).to_bytes(2, "little")

    def calibrate(self, calibration: Mapping[str, MotorCalibration]) -> None:
        """Write what `lerobot-calibrate` writes into the motors."""
        for i, name in enumerate(JOINTS):
            motor = calibration[name]
            self._set(i, _OFFSET, motor.homing_offset)
            self._set(i, _LOWEST, motor.range_min)
            self._set(i, _HIGHEST, motor.range_max)

    def measure(self, position_rad: F64, velocity_rad_s: F64) -> None:
        """Let the encoders be at these joints, float64 (6,)."""
        steps = self._zeros + position_rad * STEPS / (2.0 * math.pi)
        for i, step in enumerate(steps):
            self._set(i, _POSITION, round(step) - self._get(i, _OFFSET))
            self._set(i, _VELOCITY, round(velocity_rad_s[i] * STEPS / (2.0 * math.pi)))

    def goals(self) -> tuple[F64, NDArray[np.bool_]]:
        """Joint positions that are aimed at [rad] and whether a motor has torque, each (6,)."""
        steps = np.array([self._get(i, _GOAL) + self._get(i, _OFFSET) for i in range(len(JOINTS))])
        torque = np.array([memory[_TORQUE] == 1 for memory in self._memories])
        goals: F64 = (steps - self._zeros) * 2.0 * math.pi / STEPS
        return goals, torque

    def answer(self, packet: Packet) -> bytes:
        """What the motors send back; nothing when they hear nothing."""
        faults = self.faults
        if faults.silent or self._random.random() < faults.lost_share:
            return b""
        if packet.instruction == SYNC_WRITE:
            self._sync_write(packet.parameters)
            return b""
        if packet.instruction == SYNC_READ:
            address, count = packet.parameters[:2]
            motors = packet.parameters[2:]
            return b"".join(self._read(number - 1, address, count) for number in motors)
        targets = range(1, len(JOINTS) + 1) if packet.motor == BROADCAST else [packet.motor]
        known = [number - 1 for number in targets if 1 <= number <= len(JOINTS)]
        if packet.instruction == PING:
            return b"".join(status(i + 1, faults.error) for i in known)
        if packet.instruction == READ and known:
            return self._read(known[0], *packet.parameters[:2])
        if packet.instruction == WRITE and known:
            self._write(known[0], packet.parameters[0], packet.parameters[1:])
            return status(known[0] + 1, faults.error)
        return b""

    def _read(self, i: int, address: int, count: int) -> bytes:
        data = bytes(self._memories[i][address : address + count])
        wrong = (self.faults.wrong or {}).get(JOINTS[i], 0)
        if wrong and address == _POSITION:
            value = encode(self._get(i, _POSITION) + wrong, _SIGN_BIT[_POSITION])
            data = value.to_bytes(2, "little") + data[2:]
        return status(i + 1, self.faults.error, data)

    def _sync_write(self, parameters: bytes) -> None:
        address, count = parameters[:2]
        for start in range(2, len(parameters), count + 1):
            number = parameters[start]
            if 1 <= number <= len(JOINTS):
                self._write(number - 1, address, parameters[start + 1 : start + 1 + count])

    def _write(self, i: int, address: int, data: bytes) -> None:
        memory, name = self._memories[i], JOINTS[i]
        if address < _EEPROM_END and memory[_LOCK]:
            self.broken_rules.append(f"{name}: register {address} written while it was locked")
            return
        had_torque = memory[_TORQUE] == 1
        memory[address : address + len(data)] = data
        if address == _TORQUE and memory[_TORQUE] == 1 and not had_torque:
            self._set(i, _GOAL, self._get(i, _POSITION))  # as the motor does: it stays
        if address == _GOAL:
            self._judge_goal(i, had_torque)

    def _judge_goal(self, i: int, has_torque: bool) -> None:
        """A goal beyond the limits is clamped by the motor."""
        goal, low, high = self._get(i, _GOAL), self._get(i, _LOWEST), self._get(i, _HIGHEST)
        if not low <= goal <= high:
            self.broken_rules.append(f"{JOINTS[i]}: goal {goal} outside {low}..{high}")
            self._set(i, _GOAL, min(max(goal, low), high))
        if not has_torque:
            self.broken_rules.append(f"{JOINTS[i]}: goal {goal} without torque")

    def _get(self, i: int, address: int) -> int:
        value = int.from_bytes(self._memories[i][address : address + 2], "little")
        sign_bit = _SIGN_BIT.get(address)
        return value if sign_bit is None else decode(value, sign_bit)

    def _set(self, i: int, address: int, value: int) -> None:
        sign_bit = _SIGN_BIT.get(address)
        raw = value if sign_bit is None else encode(value, sign_bit)
        self._memories[i][address : address + 2] = raw.to_bytes(2, "little")
