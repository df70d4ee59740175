"""Packets of the motors' serial protocol.

Source: Feetech, protocol of the SMS/STS series: FF FF, motor id, length, instruction (or error of
an answer), parameters, checksum (the complement of the sum from the id on).
"""

from __future__ import annotations

from collections.abc import Sequence

from rn_robot_lerobot.bus import chain
from rn_robot_lerobot.bus.chain import BROADCAST, SYNC_WRITE, Packet

_HEADER = b"\xff\xff"
_LONGEST = 250


def checksum(body: bytes) -> int:
    """Checksum of the bytes between the header and the checksum."""
    return ~sum(body) & 0xFF


def status(motor: int, error: int, data: bytes = b"") -> bytes:
    """Status packet of a motor."""
    body = bytes((motor, len(data) + 2, error)) + data
    return _HEADER + body + bytes((checksum(body),))


def sync_write(motors: Sequence[int], address: int, data: bytes) -> bytes:
    """Instruction that writes the same data into several motors; none of them answers."""
    rows = b"".join(bytes((motor,)) + data for motor in motors)
    parameters = bytes((address, len(data))) + rows
    body = bytes((BROADCAST, len(parameters) + 2, SYNC_WRITE)) + parameters
    return _HEADER + body + bytes((checksum(body),))


class FeetechPacketReader(chain.PacketReader):
    """Reader for this protocol."""

    header = _HEADER
    least = 4

    def _size(self, begun: bytes) -> int | None:
        motor, length = begun[2], begun[3]
        return 4 + length if motor != 0xFF and 2 <= length <= _LONGEST else None

    def _packet(self, whole: bytes) -> Packet | None:
        body = whole[2:-1]
        return Packet(body[0], body[2], body[3:]) if whole[-1] == checksum(body) else None
