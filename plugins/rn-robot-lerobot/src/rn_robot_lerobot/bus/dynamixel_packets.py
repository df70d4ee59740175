"""Packets of Dynamixel's serial protocol 2.0.

Source: ROBOTIS, DYNAMIXEL protocol 2.0: FF FF FD 00, motor id, length (two bytes), instruction,
parameters, CRC-16. If FF FF FD occurs in instruction and parameters, another FD is inserted after
it. An answer has the instruction 55, and its parameters begin with the error.
"""

from __future__ import annotations

from rn_robot_lerobot.bus import chain
from rn_robot_lerobot.bus.chain import Packet

_HEADER = b"\xff\xff\xfd\x00"
_MARK, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
_STATUS = 0x55
_POLYNOMIAL = 0x8005
_LONGEST = 250
_BEFORE = 7
"""Number of bytes before the instruction."""


def crc(data: bytes) -> int:
    """CRC-16 (polynomial 8005, initial value 0, not reflected)."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1) ^ (_POLYNOMIAL if value & 0x8000 else 0)
            value &= 0xFFFF
    return value


def packed(motor: int, instruction: int, parameters: bytes) -> bytes:
    """Serialise a packet."""
    body = (bytes((instruction,)) + parameters).replace(_MARK, _STUFFED)
    head = _HEADER + bytes((motor,)) + (len(body) + 2).to_bytes(2, "little")
    return head + body + crc(head + body).to_bytes(2, "little")


def status(motor: int, error: int, data: bytes = b"") -> bytes:
    """Status packet of a motor."""
    return packed(motor, _STATUS, bytes((error,)) + data)


class DynamixelPacketReader(chain.PacketReader):
    """Reader for protocol 2.0."""

    header = _HEADER
    least = _BEFORE

    def _size(self, begun: bytes) -> int | None:
        length = int.from_bytes(begun[5:_BEFORE], "little")
        return _BEFORE + length if 3 <= length <= _LONGEST else None

    def _packet(self, whole: bytes) -> Packet | None:
        if crc(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
            return None
        body = whole[_BEFORE:-2].replace(_STUFFED, _MARK)
        return Packet(whole[4], body[0], body[1:])
