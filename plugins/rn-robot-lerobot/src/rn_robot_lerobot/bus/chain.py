"""Motors on a serial bus: their registers, and the scale between registers and joints. Pure
computation, independent of the protocol.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_robot_lerobot.calibration import STEPS, MotorCalibration

F64 = NDArray[np.float64]

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
"""Instructions of both protocols."""
BROADCAST = 0xFE


@dataclass(frozen=True, slots=True)
class Packet:
    """One instruction.

    Attributes:
        motor: id of the motor, or `BROADCAST`.
        instruction: one of the constants above.
        parameters: its parameters.
    """

    motor: int
    instruction: int
    parameters: bytes


class PacketReader(ABC):
    """Finds packets in a stream of bytes.

    Attributes:
        header: first bytes of each packet.
        least: number of bytes after which a packet's size is known.
        damaged: number of packets with a wrong checksum.
    """

    header: ClassVar[bytes]
    least: ClassVar[int]

    def __init__(self) -> None:
        self._buffer = b""
        self.damaged = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Packets completed by these bytes."""
        self._buffer += data
        found: list[Packet] = []
        while (start := self._buffer.find(self.header)) >= 0:
            self._buffer = self._buffer[start:]
            if len(self._buffer) < self.least:
                break
            size = self._size(self._buffer)
            if size is None:
                self._buffer = self._buffer[1:]
                continue
            if len(self._buffer) < size:
                break
            whole, self._buffer = self._buffer[:size], self._buffer[size:]
            packet = self._packet(whole)
            if packet is None:
                self.damaged += 1
            else:
                found.append(packet)
        return found

    @abstractmethod
    def _size(self, begun: bytes) -> int | None:
        """Size in bytes of the packet that begins here; None if none can begin here."""

    @abstractmethod
    def _packet(self, whole: bytes) -> Packet | None:
        """Parse a packet; None if its checksum is wrong."""


@dataclass(kw_only=True)
class BusFaults:
    """Faults of the bus; may be changed at any time.

    Attributes:
        silent: nothing is answered, and nothing arrives.
        mute: nothing is answered, but instructions arrive.
        lost_share: share of lost instructions, 0..1.
        answer_delay_s: delay of each answer [s].
        wrong: steps added to a motor's reported position, by the joint's name.
        error: error bits of every answer.
    """

    silent: bool = False
    mute: bool = False
    lost_share: float = 0.0
    answer_delay_s: float = 0.0
    wrong: Mapping[str, int] | None = None
    error: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Registers:
    """Register layout of a motor: addresses and sizes in bytes.

    Attributes:
        size: size of the whole memory.
        width: size of the numbers below; the motor's id and the torque have one byte.
        number, torque: registers of one byte.
        model: register of two bytes.
        lowest, highest, offset, goal, position, velocity: registers of `width` bytes.
        permanent_end: first address after the permanent memory.
    """

    size: int
    width: int
    number: int
    model: int
    torque: int
    lowest: int
    highest: int
    offset: int
    goal: int
    position: int
    velocity: int
    permanent_end: int


class MotorChain(ABC):
    """Motors 1 to n on one bus.

    Attributes:
        registers: register layout of every motor.
        offset_sign: sign of the homing offset in reported positions.
        address_size: size of an address or a count in an instruction.
        faults: current faults.
        broken_rules: descriptions of violations by the master, oldest first.
    """

    registers: Registers
    offset_sign: int
    address_size: int

    def __init__(
        self,
        joints: Sequence[str],
        models: Sequence[int],
        encoder_zeros: Mapping[str, int],
        *,
        seed: int = 0,
    ) -> None:
        """Args:
        joints, models: joint and model number of each motor.
        encoder_zeros: encoder step, without an offset, at each joint's position 0.
        seed: seed of the random losses.
        """
        self.faults = BusFaults()
        self.broken_rules: list[str] = []
        self.joints = tuple(joints)
        self._zeros = np.array([encoder_zeros[name] for name in self.joints])
        self._random = np.random.default_rng(seed)
        self.memories = [bytearray(self.registers.size) for _ in self.joints]
        for i, model in enumerate(models):
            memory = self.memories[i]
            memory[self.registers.model : self.registers.model + 2] = model.to_bytes(2, "little")
            memory[self.registers.number] = i + 1
            self.set(i, self.registers.highest, STEPS - 1)

    @abstractmethod
    def encode(self, address: int, value: int) -> int:
        """Unsigned register content for `value`."""

    @abstractmethod
    def decode(self, address: int, raw: int) -> int:
        """Value of an unsigned register content."""

    @abstractmethod
    def status(self, i: int, data: bytes = b"", *, error: int = 0) -> bytes:
        """Answer of a motor, with `error` in addition to the error bits of `faults`."""

    @abstractmethod
    def answer_ping(self, i: int) -> bytes:
        """Answer of a motor to `PING`."""

    @abstractmethod
    def write(self, i: int, address: int, data: bytes) -> int:
        """Write into a motor's memory as far as permitted; return the error of its answer."""

    def turns(self, i: int) -> int:
        """1, or -1 for an inverted motor."""
        return 1

    def is_wheel(self, i: int) -> bool:
        """True if a motor follows a speed instead of a position."""
        return False

    def goal_steps_s(self, i: int) -> int:
        """Goal speed of a wheel [steps/s]."""
        return 0

    def speeds(self) -> dict[int, float]:
        """Speed [rad/s] of each wheel with torque, by its index in `joints`."""
        return {
            i: self.turns(i) * self.goal_steps_s(i) * 2.0 * math.pi / STEPS
            for i in range(len(self.joints))
            if self.is_wheel(i) and self.has_torque(i)
        }

    def calibrate(self, calibration: Mapping[str, MotorCalibration]) -> None:
        """Write the values of `lerobot-calibrate` into the motors."""
        for i, name in enumerate(self.joints):
            motor = calibration[name]
            self.set(i, self.registers.offset, motor.homing_offset)
            self.set(i, self.registers.lowest, motor.range_min)
            self.set(i, self.registers.highest, motor.range_max)

    def measure(self, position_rad: F64, velocity_rad_s: F64) -> None:
        """Set the encoders to these joint states, float64 (n,)."""
        steps = self._zeros + position_rad * STEPS / (2.0 * math.pi)
        for i, step in enumerate(steps):
            turned = self.turns(i) * round(step)
            if self.is_wheel(i):
                turned %= STEPS
            self.set(i, self.registers.position, turned + self._shift(i))
            speed = round(velocity_rad_s[i] * STEPS / (2.0 * math.pi))
            self.set(i, self.registers.velocity, self.turns(i) * speed)

    def _shift(self, i: int) -> int:
        """Difference between a motor's encoder and its reported position [steps]."""
        return self.offset_sign * self.get(i, self.registers.offset)

    def goals(self) -> tuple[F64, NDArray[np.bool_]]:
        """Goal positions of the joints [rad], and which motors have torque, each (n,)."""
        count = range(len(self.joints))
        told = [self.get(i, self.registers.goal) - self._shift(i) for i in count]
        steps = np.array([self.turns(i) * told[i] for i in count])
        torque = np.array([self.has_torque(i) for i in count])
        goals: F64 = (steps - self._zeros) * 2.0 * math.pi / STEPS
        return goals, torque

    def has_torque(self, i: int) -> bool:
        """True if a motor has torque."""
        return self.memories[i][self.registers.torque] == 1

    def answer(self, packet: Packet) -> bytes:
        """Answers of the motors to an instruction; empty if it does not arrive."""
        faults = self.faults
        if faults.silent or self._random.random() < faults.lost_share:
            return b""
        answer = self._answer(packet)
        return b"" if faults.mute else answer

    def _answer(self, packet: Packet) -> bytes:
        size = self.address_size
        parameters = packet.parameters
        address = int.from_bytes(parameters[:size], "little")
        count = int.from_bytes(parameters[size : 2 * size], "little")
        if packet.instruction == SYNC_WRITE:
            for start in range(2 * size, len(parameters), count + 1):
                i = parameters[start] - 1
                if 0 <= i < len(self.joints):
                    self.write(i, address, parameters[start + 1 : start + 1 + count])
            return b""
        if packet.instruction == SYNC_READ:
            return b"".join(self.read(n - 1, address, count) for n in parameters[2 * size :])
        every = range(1, len(self.joints) + 1)
        targets = every if packet.motor == BROADCAST else [packet.motor]
        known = [number - 1 for number in targets if number in every]
        if packet.instruction == PING:
            return b"".join(map(self.answer_ping, known))
        if packet.instruction == READ and known:
            return self.read(known[0], address, count)
        if packet.instruction == WRITE and known:
            error = self.write(known[0], address, parameters[size:])
            return self.status(known[0], error=error)
        return b""

    def read(self, i: int, address: int, count: int) -> bytes:
        """Answer of a motor with a part of its memory."""
        data = bytes(self.memories[i][address : address + count])
        wrong = (self.faults.wrong or {}).get(self.joints[i], 0)
        position, width = self.registers.position, self.registers.width
        if wrong and address == position:
            value = self.encode(position, self.get(i, position) + wrong)
            data = value.to_bytes(width, "little") + data[width:]
        return self.status(i, data)

    def take_goal(self, i: int, *, is_bounded: bool) -> None:
        """Check a written goal; the motor clamps one beyond the limits."""
        registers, name = self.registers, self.joints[i]
        goal = self.get(i, registers.goal)
        if self.is_wheel(i):
            self.broken_rules.append(f"{name}: goal {goal} for a motor that rolls")
        low, high = self.get(i, registers.lowest), self.get(i, registers.highest)
        if is_bounded and not low <= goal <= high:
            self.broken_rules.append(f"{name}: goal {goal} outside {low}..{high}")
            self.set(i, registers.goal, min(max(goal, low), high))
        if not self.has_torque(i):
            self.broken_rules.append(f"{name}: goal {goal} without torque")

    def stay(self, i: int) -> None:
        """Set the goal to the current position, as a motor does when its torque is switched on."""
        self.set(i, self.registers.goal, self.get(i, self.registers.position))

    def get(self, i: int, address: int) -> int:
        """Read a number of `width` bytes."""
        raw = self.memories[i][address : address + self.registers.width]
        return self.decode(address, int.from_bytes(raw, "little"))

    def set(self, i: int, address: int, value: int) -> None:
        """Store a number of `width` bytes."""
        width = self.registers.width
        raw = self.encode(address, value).to_bytes(width, "little")
        self.memories[i][address : address + width] = raw
