"""Packets of the motors' serial protocol.

Source: Feetech, protocol of the SMS/STS series: FF FF, number of the motor, length, instruction (or
error of an answer), parameters, checksum (the complement of the sum from the number on).
"""

from __future__ import annotations

from rn_robot_lerobot.bus.chain import Packet

_HEADER = b"\xff\xff"
_LONGEST = 250


def checksum(body: bytes) -> int:
    """Of everything between the header and itself."""
    return ~sum(body) & 0xFF


def status(motor: int, error: int, data: bytes = b"") -> bytes:
    """The answer of a motor."""
    body = bytes((motor, len(data) + 2, error)) + data
    return _HEADER + body + bytes((checksum(body),))


class PacketReader:
    """Finds packets in a stream of bytes.

    Attributes:
        damaged: packets with a wrong checksum so far.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.damaged = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Packets that are complete with these bytes."""
        self._buffer += data
        found: list[Packet] = []
        while (start := self._buffer.find(_HEADER)) >= 0:
            self._buffer = self._buffer[start:]
            if len(self._buffer) < 4:
                break
            motor, length = self._buffer[2], self._buffer[3]
            if motor == 0xFF or not 2 <= length <= _LONGEST:
                self._buffer = self._buffer[1:]
                continue
            end = 4 + length
            if len(self._buffer) < end:
                break
            body, check = self._buffer[2 : end - 1], self._buffer[end - 1]
            self._buffer = self._buffer[end:]
            if check != checksum(body):
                self.damaged += 1
                continue
            found.append(Packet(motor, body[2], body[3:]))
        return found
