"""Instructions of a master for simulated motors, in either protocol; independent of any driver."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rn_robot_lerobot.bus import dynamixel_packets, packets
from rn_robot_lerobot.bus.arm import SERIAL_KOCH, SERIAL_LEKIWI, SERIAL_SO101, SerialKind
from rn_robot_lerobot.bus.chain import (
    BROADCAST,
    READ,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    MotorChain,
    Packet,
)


def feetech(packet: Packet) -> bytes:
    """Serialise a packet of Feetech's protocol."""
    body = bytes((packet.motor, len(packet.parameters) + 2, packet.instruction))
    body += packet.parameters
    return b"\xff\xff" + body + bytes((packets.checksum(body),))


def dynamixel(packet: Packet) -> bytes:
    """Serialise a packet of Dynamixel's protocol."""
    return dynamixel_packets.packed(packet.motor, packet.instruction, packet.parameters)


@dataclass(frozen=True, kw_only=True, slots=True)
class Dialect:
    """Protocol of a master for one kind of motors.

    Attributes:
        kind: kind of the arm.
        raw: serialises a packet.
        error_at: position of the error in an answer, before its data.
        tail: number of checksum bytes.
    """

    kind: SerialKind
    raw: Callable[[Packet], bytes]
    error_at: int
    tail: int


FEETECH = Dialect(kind=SERIAL_SO101, raw=feetech, error_at=4, tail=1)
DYNAMIXEL = Dialect(kind=SERIAL_KOCH, raw=dynamixel, error_at=8, tail=2)
LEKIWI = Dialect(kind=SERIAL_LEKIWI, raw=feetech, error_at=4, tail=1)


class Master:
    """Calibrated motors at 0, and requests to them.

    Attributes:
        motors: the motors.
    """

    def __init__(self, dialect: Dialect) -> None:
        self.dialect = dialect
        assembled = dialect.kind.assembled
        self.motors: MotorChain = dialect.kind.chain(assembled.encoder_zeros)
        self.motors.calibrate(assembled.calibration())
        self.count = len(self.motors.joints)
        self.move()

    def move(self, angles: Mapping[int, float] | None = None, speed: float = 0.0) -> None:
        """Set motors to angles [rad], by their ids, and others to 0; all with one speed."""
        position = np.zeros(self.count)
        for number, angle in (angles or {}).items():
            position[number - 1] = angle
        self.motors.measure(position, np.full(self.count, speed))

    def number(self, value: int) -> bytes:
        """Encode a number as in a register."""
        registers = self.motors.registers
        raw = self.motors.encode(registers.goal, value)
        return raw.to_bytes(registers.width, "little")

    def write(self, motor: int, address: int, data: bytes) -> int:
        """Write data; return the error of the answer."""
        answer = self.motors.answer(Packet(motor, WRITE, self._place(address) + data))
        return answer[self.dialect.error_at]

    def read(self, motor: int, address: int) -> int:
        """Read a number of the motors' width."""
        width = self.motors.registers.width
        answer = self.ask(motor, address)
        begin = self.dialect.error_at + 1
        return self.motors.decode(address, int.from_bytes(answer[begin : begin + width], "little"))

    def ask(self, motor: int, address: int) -> bytes:
        """Read; return the whole answer."""
        parameters = self._place(address) + self._place(self.motors.registers.width)
        return self.motors.answer(Packet(motor, READ, parameters))

    def read_all(self, address: int) -> bytes:
        """Read from all motors; return the answers."""
        size = self.motors.registers.width
        numbers = bytes(range(1, self.count + 1))
        parameters = self._place(address) + self._place(size) + numbers
        return self.motors.answer(Packet(BROADCAST, SYNC_READ, parameters))

    def write_all(self, address: int, values: Sequence[int]) -> bytes:
        """Write a number to each motor; return the answers."""
        rows = [bytes((i, *self.number(value))) for i, value in enumerate(values, 1)]
        parameters = self._place(address) + self._place(self.motors.registers.width)
        return self.motors.answer(Packet(BROADCAST, SYNC_WRITE, parameters + b"".join(rows)))

    def power(self, *numbers: int) -> None:
        """Switch the torque on."""
        for number in numbers:
            assert self.write(number, self.motors.registers.torque, b"\x01") == 0

    def _place(self, value: int) -> bytes:
        return value.to_bytes(self.motors.address_size, "little")
