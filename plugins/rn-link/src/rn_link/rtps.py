"""RTPS messages on their way between machines: what they announce, and addresses put right.

A participant of the link announces the loopback address, which on another machine is another
loopback. There the relay takes its messages at an address of its own for that machine.

Source: OMG DDSI-RTPS 2.5, 8.3.3 (messages), 9.3.2 (locators), 9.6.2 (discovery parameters).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

_HEADER_BYTES: Final = 20
_MESSAGE: Final = b"RTPS"
_PARTICIPANT: Final = slice(8, 20)
_DATA: Final = 0x15
_BUILTIN: Final = (0xC2, 0xC3)
"""Kinds of the writers of discovery, with and without key."""
_METATRAFFIC: Final = 0x32
_LOCATOR: Final = re.compile(
    # unicast of an endpoint, default unicast, metatraffic unicast; 24 bytes, UDPv4, little-endian
    rb"([\x2f\x31\x32])\x00\x18\x00\x01\x00\x00\x00(..)(\x00{14})\x7f\x00\x00\x01",
    re.DOTALL,
)
_PORT_BASE: Final = 7400
_DOMAIN_PORTS: Final = 250


@dataclass(frozen=True, slots=True)
class Announcement:
    """What a message of discovery says of its sender.

    Attributes:
        participant: 12 bytes, unlike those of all other participants, also of earlier ones.
        ports: UDP ports at which the sender takes messages.
        metatraffic: those of them for discovery.
    """

    participant: bytes
    ports: frozenset[int]
    metatraffic: frozenset[int]

    @property
    def domains(self) -> frozenset[int]:
        """ROS domains of the sender; empty when it names no port, as one that leaves."""
        return frozenset(map(domain_of, self.metatraffic))


def domain_of(port: int) -> int:
    """The ROS domain that a port of discovery belongs to."""
    return (port - _PORT_BASE) // _DOMAIN_PORTS


def read_announcement(message: bytes) -> Announcement:
    """Return the loopback ports that a message announces."""
    found = [
        (locator[1][0], int.from_bytes(locator[2], "little"))
        for begin, end in _discovery_data(message)
        for locator in _LOCATOR.finditer(message, begin, end)
    ]
    return Announcement(
        message[_PARTICIPANT],
        frozenset(port for _, port in found),
        frozenset(port for kind, port in found if kind == _METATRAFFIC),
    )


def with_places(message: bytes, places: Mapping[int, tuple[bytes, int]]) -> bytes:
    """Return the message with other places instead of the loopback ports that it announces.

    Args:
        places: address (4 bytes) and port, by port.
    """
    changed = bytearray(message)
    for begin, end in _discovery_data(message):
        for locator in _LOCATOR.finditer(message, begin, end):
            place = places.get(int.from_bytes(locator[2], "little"))
            if place is not None:
                address, port = place
                changed[locator.start(2) : locator.end()] = (
                    port.to_bytes(2, "little") + locator[3] + address
                )
    return bytes(changed)


def _discovery_data(message: bytes) -> Iterator[tuple[int, int]]:
    """Where the data of discovery begins and ends; data of users may hold anything."""
    if not message.startswith(_MESSAGE):
        return
    begin = _HEADER_BYTES
    while begin + 4 <= len(message):
        kind, flags = message[begin], message[begin + 1]
        (length,) = struct.unpack_from("<H" if flags & 1 else ">H", message, begin + 2)
        # 0: up to the end of the message
        end = begin + 4 + length if length else len(message)
        # flags, offset, reader and writer come first
        if kind == _DATA and begin + 16 <= len(message) and message[begin + 15] in _BUILTIN:
            yield begin + 16, min(end, len(message))
        begin = end
