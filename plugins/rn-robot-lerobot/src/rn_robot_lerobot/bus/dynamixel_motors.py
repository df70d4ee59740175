"""The six motors of a simulated Koch arm. Pure computation.

A position register holds the encoder's steps (4096 per turn) plus the homing offset, low byte
first, negative numbers as two's complement. Source: ROBOTIS, control tables of XL430-W250 and
XL330-M288.
"""

from __future__ import annotations

from collections.abc import Mapping

from rn_robot_lerobot.arm import JOINTS
from rn_robot_lerobot.bus import dynamixel_packets
from rn_robot_lerobot.bus.chain import MotorChain, Registers

MODEL_XL430, MODEL_XL330 = 1060, 1200
MODELS = (MODEL_XL430,) * 2 + (MODEL_XL330,) * 4
ALERT = 0x80
"""Error bit of an answer: the motor has a hardware error."""
ACCESS_ERROR = 0x07
POSITION_MODE, EXTENDED_MODE, CURRENT_MODE = 3, 4, 5
_DRIVE_MODE, _OPERATING_MODE = 10, 11
_INVERTED = 1
_NUMBER_BITS = 32
_FIRMWARE_BYTES = b"\x2e"
_REGISTERS = Registers(
    size=160,
    width=4,
    number=7,
    model=0,
    torque=64,
    lowest=52,
    highest=48,
    offset=20,
    goal=116,
    position=132,
    velocity=128,
    permanent_end=64,
)


class DynamixelChain(MotorChain):
    """Motors 1 to 6 on one bus."""

    registers = _REGISTERS
    offset_sign = 1
    address_size = 2

    def __init__(self, encoder_zeros: Mapping[str, int], *, seed: int = 0) -> None:
        """See `MotorChain`."""
        super().__init__(JOINTS, MODELS, encoder_zeros, seed=seed)
        for memory in self.memories:
            memory[_OPERATING_MODE] = POSITION_MODE

    def invert(self, joint: str) -> None:
        """Invert a motor's drive mode, as for a motor mounted in reverse."""
        self.memories[self.joints.index(joint)][_DRIVE_MODE] = _INVERTED

    def turns(self, i: int) -> int:
        """See `MotorChain`."""
        return -1 if self.memories[i][_DRIVE_MODE] & _INVERTED else 1

    def encode(self, address: int, value: int) -> int:
        """See `MotorChain`."""
        return value % (1 << _NUMBER_BITS)

    def decode(self, address: int, raw: int) -> int:
        """See `MotorChain`."""
        return raw - (1 << _NUMBER_BITS) if raw >> (_NUMBER_BITS - 1) else raw

    def status(self, i: int, data: bytes = b"", *, error: int = 0) -> bytes:
        """See `MotorChain`."""
        return dynamixel_packets.status(i + 1, self.faults.error | error, data)

    def answer_ping(self, i: int) -> bytes:
        """See `MotorChain`."""
        return self.status(i, bytes(self.memories[i][:2]) + _FIRMWARE_BYTES)

    def write(self, i: int, address: int, data: bytes) -> int:
        """See `MotorChain`."""
        memory, registers = self.memories[i], self.registers
        had_torque = self.has_torque(i)
        if address < registers.permanent_end and had_torque:
            self.broken_rules.append(
                f"{self.joints[i]}: register {address} written while it had torque"
            )
            return ACCESS_ERROR
        memory[address : address + len(data)] = data
        if address == registers.torque and self.has_torque(i) and not had_torque:
            self.stay(i)
        if address == registers.goal:
            # extended mode (several turns) has no limits
            self.take_goal(i, is_bounded=memory[_OPERATING_MODE] == POSITION_MODE)
        return 0
