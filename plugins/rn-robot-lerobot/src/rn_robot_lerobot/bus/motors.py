"""The motors of a simulated SO-101 or LeKiwi. Pure computation.

A position register holds the encoder's steps (4096 per turn) minus the homing offset, low byte
first, with a sign bit for negative numbers. Source: Feetech, memory table of the STS3215.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rn_robot_lerobot.bus import packets
from rn_robot_lerobot.bus.chain import MotorChain, Registers

MODEL_STS3215 = 777
OVERLOAD = 0x20
"""Error bit of an answer."""
POSITION_MODE, VELOCITY_MODE = 0, 1
_FIRMWARE, _OPERATING_MODE, _GOAL_VELOCITY, _LOCK = 0, 33, 46, 55
_REGISTERS = Registers(
    size=100,
    width=2,
    number=5,
    model=3,
    torque=40,
    lowest=9,
    highest=11,
    offset=31,
    goal=42,
    position=56,
    velocity=58,
    permanent_end=40,
)
_SIGN_BIT = {31: 11, 42: 15, 46: 15, 56: 15, 58: 15}


def encode(value: int, sign_bit: int) -> int:
    """Encode a number as sign and magnitude."""
    return abs(value) | (1 << sign_bit if value < 0 else 0)


def decode(value: int, sign_bit: int) -> int:
    """Decode a number from sign and magnitude."""
    magnitude = value & ((1 << sign_bit) - 1)
    return -magnitude if value >> sign_bit & 1 else magnitude


def wheel_stop(motors: Sequence[int]) -> tuple[bytes, bytes]:
    """Packets that stop motors in velocity mode: speed 0, then torque off, so that later speeds
    have no effect.
    """
    return (
        packets.sync_write(motors, _GOAL_VELOCITY, bytes(_REGISTERS.width)),
        packets.sync_write(motors, _REGISTERS.torque, bytes(1)),
    )


class FeetechChain(MotorChain):
    """Motors 1 to n on one bus."""

    registers = _REGISTERS
    offset_sign = -1
    address_size = 1

    def __init__(self, encoder_zeros: Mapping[str, int], *, seed: int = 0) -> None:
        """See `MotorChain`."""
        joints = tuple(encoder_zeros)
        super().__init__(joints, [MODEL_STS3215] * len(joints), encoder_zeros, seed=seed)
        for memory in self.memories:
            memory[_FIRMWARE : _FIRMWARE + 2] = bytes((3, 10))

    def is_wheel(self, i: int) -> bool:
        """See `MotorChain`."""
        return self.memories[i][_OPERATING_MODE] == VELOCITY_MODE

    def goal_steps_s(self, i: int) -> int:
        """See `MotorChain`."""
        return self.get(i, _GOAL_VELOCITY)

    def encode(self, address: int, value: int) -> int:
        """See `MotorChain`."""
        return encode(value, _SIGN_BIT[address]) if address in _SIGN_BIT else value

    def decode(self, address: int, raw: int) -> int:
        """See `MotorChain`."""
        return decode(raw, _SIGN_BIT[address]) if address in _SIGN_BIT else raw

    def status(self, i: int, data: bytes = b"", *, error: int = 0) -> bytes:
        """See `MotorChain`."""
        return packets.status(i + 1, self.faults.error | error, data)

    def answer_ping(self, i: int) -> bytes:
        """See `MotorChain`."""
        return self.status(i)

    def write(self, i: int, address: int, data: bytes) -> int:
        """See `MotorChain`."""
        memory, registers = self.memories[i], self.registers
        if address < registers.permanent_end and memory[_LOCK]:
            self.broken_rules.append(
                f"{self.joints[i]}: register {address} written while it was locked"
            )
            return 0
        had_torque = self.has_torque(i)
        memory[address : address + len(data)] = data
        if address == registers.torque and self.has_torque(i) and not had_torque:
            self.stay(i)
        if address == registers.goal:
            self.take_goal(i, is_bounded=True)
        rolls = self.is_wheel(i) and self.has_torque(i)
        if address == _GOAL_VELOCITY and self.goal_steps_s(i) and not rolls:
            self.broken_rules.append(f"{self.joints[i]}: speed for a motor that does not roll")
        return 0
