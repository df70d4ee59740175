"""RTPS messages between machines: reading of announcements, and replacement of addresses.

A participant of the link announces the loopback address, which is a different host on another
machine. There, the relay receives its messages at a local address that represents that machine.

Source: OMG DDSI-RTPS 2.5, 8.3.3 (messages), 9.3.2 (locators), 9.6.2 (discovery parameters).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

_HEADER_BYTES: Final = 20
_MESSAGE: Final = b"RTPS"
_PARTICIPANT: Final = slice(8, 20)
_DATA: Final = 0x15
_BUILTIN: Final = (0xC2, 0xC3)
"""Entity kinds of the discovery writers, with and without key."""
_METATRAFFIC: Final = b"\x32"
_LOCATOR: Final = re.compile(
    # unicast of an endpoint, default unicast, metatraffic unicast; 24 bytes, UDPv4, little-endian
    rb"([\x2f\x31\x32])\x00\x18\x00\x01\x00\x00\x00(..)\x00{14}\x7f\x00\x00\x01",
    re.DOTALL,
)
_PORT_BASE: Final = 7400
_DOMAIN_PORTS: Final = 250


class Announcement(NamedTuple):
    """Contents of a discovery message.

    Attributes:
        participant: 12 bytes, unique among all participants, including earlier ones.
        ports: UDP ports at which the sender receives messages.
        metatraffic: the ones for discovery.
    """

    participant: bytes
    ports: frozenset[int]
    metatraffic: frozenset[int]

    @property
    def domains(self) -> frozenset[int]:
        """ROS domains of the sender; empty if it names no port, for instance when it leaves."""
        return frozenset(map(domain_of, self.metatraffic))


def domain_of(port: int) -> int:
    """The ROS domain of a discovery port."""
    return (port - _PORT_BASE) // _DOMAIN_PORTS


def read_announcement(message: bytes) -> Announcement:
    """Return the loopback ports that a message announces."""
    found = [(locator[1], _port(locator)) for locator in _locators(message)]
    return Announcement(
        message[_PARTICIPANT],
        frozenset(port for _, port in found),
        frozenset(port for kind, port in found if kind == _METATRAFFIC),
    )


def with_places(message: bytes, places: Mapping[int, tuple[bytes, int]]) -> bytes:
    """Return the message with the announced loopback ports replaced by other addresses.

    Args:
        places: new address (4 bytes) and port, by announced port.
    """
    changed = bytearray(message)
    for locator in _locators(message):
        if place := places.get(_port(locator)):
            changed[locator.end() - 4 : locator.end()] = place[0]
            changed[slice(*locator.span(2))] = place[1].to_bytes(2, "little")
    return bytes(changed)


def _port(locator: re.Match[bytes]) -> int:
    return int.from_bytes(locator[2], "little")


def _locators(message: bytes) -> Iterator[re.Match[bytes]]:
    """Loopback addresses in discovery data; user data may contain anything and is skipped."""
    begin = _HEADER_BYTES if message.startswith(_MESSAGE) else len(message)
    while begin + 4 <= len(message):
        kind, flags = message[begin], message[begin + 1]
        (length,) = struct.unpack_from("<H" if flags & 1 else ">H", message, begin + 2)
        # 0: until the end of the message
        end = begin + 4 + length if length else len(message)
        # preceded by flags, offset, reader and writer
        if kind == _DATA and begin + 16 <= len(message) and message[begin + 15] in _BUILTIN:
            yield from _LOCATOR.finditer(message, begin + 16, min(end, len(message)))
        begin = end
